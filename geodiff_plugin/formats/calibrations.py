"""Table of calibration formats: how to recognise each from its content, and its reader (S3.3)."""

from __future__ import annotations

from geodiff_plugin.formats import (
    colmap,
    devices,
    matlab,
    named,
    posed,
    quest,
    ros,
    slam,
    spatial,
    stereo,
    transforms,
)
from geodiff_plugin.formats.posed import PosedCameras
from geodiff_plugin.formats.rigs import CalibrationFormat

_NUMBER = r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?"
#: Matches a line of four numbers.
_ROW = rf"{_NUMBER}(?:[ \t]+{_NUMBER}){{3}}[ \t]*(?:\r?\n|\Z)"
#: Matches a line that starts with the name of a camera, its matrix or its position.
_NAME_OF_CAMERA = (
    r"^[ \t]*(?:[\w.-]*(?i:cam|intrin|extrin|matrix|mtx|dist|stereo|rotation|translation|baseline|left|right)"
    r"[\w.-]*|[KMDRTP][\w.]?\w?)[ \t]*(?::|=(?!=))"
)


def _json(*keys: str) -> str:
    """Return a pattern for JSON that contains all of these keys anywhere."""
    return r"\A\s*[{\[]" + "".join(rf'(?=[\s\S]*"{key}")' for key in keys)


def _of(outer: str, keys: str) -> str:
    """Prefix keys with the name of the outer entry."""
    return " ".join(f"{outer}.{key}" for key in keys.split())


#: All formats by name. The first match reads the file, so formats contained in others come first.
CALIBRATION_FORMATS: dict[str, CalibrationFormat] = {
    "middlebury": CalibrationFormat(
        "Middlebury or ETH3D calib.txt (cam0=[...])", r"^\s*cam0\s*=\s*\[", stereo.read_middlebury),
    "kitti_cam_to_cam": CalibrationFormat(
        "KITTI (P_rect_02: ...)", r"^\s*P_rect_\d+\s*:", stereo.read_kitti, uses_cameras=True),
    # Two numbers after the colon exclude OpenCV's "P1: !!opencv-matrix", YAML lists, and the penalties P1 and
    # P2 of matcher settings.
    "kitti_projections": CalibrationFormat(
        "KITTI (P0: ...)", rf"^\s*P[0-3][ \t]*:[ \t]*{_NUMBER}[ \t]+[-+.\d]", stereo.read_kitti,
        uses_cameras=True),
    "robotcar": CalibrationFormat(
        "pair of Oxford RobotCar's models (fx fy cx cy, and a 4x4)",
        rf"\A(?:\s*{_ROW}){{4}}\s*0(?:\.0*)?[ \t]+-?0(?:\.0*)?[ \t]+-?0(?:\.0*)?[ \t]+1(?:\.0*)?\s*\Z",
        PosedCameras(posed.robotcar_cameras, K="K", to_world=("pose",), rectified=True), (2,)),
    "spring": CalibrationFormat(
        "Spring's intrinsics.txt (fx fy cx cy per line)",
        rf"\A(?:\s*{_NUMBER}(?:[ \t]+{_NUMBER}){{3}}[ \t]*(?:\n|\Z))+\s*\Z", stereo.read_spring),
    "sceneflow": CalibrationFormat(
        "SceneFlow's camera_data.txt (Frame, L, R)", r"\A\s*Frame[ \t]+\d+[ \t]*\r?\n[ \t]*L[ \t]",
        stereo.read_sceneflow, by_image=True),
    "vkitti": CalibrationFormat(
        "Virtual KITTI's intrinsic.txt and extrinsic.txt (frame cameraID)", r"\A\s*frame[ \t]+cameraID\b",
        stereo.read_vkitti, (2,)),
    "foundation_stereo": CalibrationFormat(
        "K.txt of FoundationStereo (9 numbers, baseline)", r"\A(?i:[-+.\de\s,]|nan|inf)+\Z",
        stereo.read_foundation_stereo),
    "booster": CalibrationFormat(
        "Booster xml (proj_matL)", r"<opencv_st[\s\S]*proj_matL", stereo.read_booster),
    "mvsnet": CalibrationFormat(
        "pair of MVSNet cam.txt (extrinsic)", r"^\s*extrinsic\s*$",
        posed.MVSNET, (2,)),
    "zed": CalibrationFormat(
        "ZED SN*.conf ([LEFT_CAM_HD])", r"^\s*\[(LEFT|RIGHT)_CAM_\w+\]", devices.read_zed),
    "realsense": CalibrationFormat(
        "RealSense (rs-enumerate-devices -c, or rs2 as JSON)",
        rf'{devices.RS_PRINTED}|{_json("ppx")}', devices.read_realsense),
    "oak": CalibrationFormat(
        "OAK-D JSON (cameraData)", _json("cameraData"), devices.read_oak, uses_cameras=True),
    "quest": CalibrationFormat(
        "pair of QuestRealityCapture's *_camera_mruk_intrinsics.json (lensOffset)",
        _json("lensOffset", "sensorResolution"), quest.read_quest, (2,)),
    "spatial_photo": CalibrationFormat(
        "spatial photo (HEIC with a stereo pair)", _json(spatial.MARK), spatial.read_spatial_photo),
    "nerf": CalibrationFormat(
        "transforms.json of nerfstudio or instant-ngp (frames, transform_matrix)",
        _json("frames", "transform_matrix"), transforms.read_nerf, by_image=True, as_stored=True),
    "basalt": CalibrationFormat(
        "basalt's calibration.json (T_imu_cam)", _json("T_imu_cam"),
        PosedCameras(posed.basalt_cameras, K=_of("intrinsics", "fx fy cx cy"), size="size",
            model="camera_type", lenses={
                "pinhole": ("opencv", ""),
                "pinhole-radtan8": ("opencv", _of("intrinsics", "k1 k2 p1 p2 k3 k4 k5 k6")),
                "kb4": ("fisheye", _of("intrinsics", "k1 k2 k3 k4"))},
            to_world=("qx qy qz qw px py pz",), hint="Calibrate with basalt_calibrate --cam-types kb4 kb4."),
        uses_cameras=True),
    "cityscapes": CalibrationFormat(
        "Cityscapes' camera.json (u0, v0)", _json("u0", "extrinsic"), stereo.read_cityscapes),
    "matlab": CalibrationFormat(
        "MATLAB's stereoParams by jsonencode (CameraParameters1)",
        _json("CameraParameters1"), matlab.read_matlab),
    "argoverse": CalibrationFormat(
        "Argoverse's calibration of its stereo pair (vehicle_SE3_camera_)",
        _json("vehicle_SE3_camera_"), stereo.read_argoverse),
    "bouguet": CalibrationFormat(
        "Bouguet's calibration toolbox (fc_left, kc_left)", r"^[^%\n]*\bfc_left[ \t]*=[ \t]*\[",
        matlab.read_bouguet),
    "multical": CalibrationFormat(
        "multical's calibration.json (cameras, camera_poses)",
        _json("cameras", "camera_poses"),
        PosedCameras(posed.multical_cameras, K="K", size="image_size", lens="dist", pose=posed.multical_pose,
            is_asked=True, has_unit=False), uses_cameras=True),
    "mc_calib": CalibrationFormat(
        "MC-Calib's calibrated_cameras_data.yml (camera_pose_matrix)", r"^[ \t]+camera_pose_matrix[ \t]*:",
        PosedCameras(posed.mc_calib_cameras, K="camera_matrix", size="img_width img_height",
            model="distortion_type",
            lenses={0: ("opencv", "distortion_vector"), 1: ("fisheye", "distortion_vector")},
            to_world=("camera_pose_matrix",), is_asked=True, has_unit=False), uses_cameras=True),
    "mrcal": CalibrationFormat(
        "pair of mrcal's .cameramodel (lensmodel)", r"['\"]lensmodel['\"]\s*:",
        PosedCameras(posed.mrcal_cameras, K="K", size="imagersize", model="lensmodel",
            lenses=dict.fromkeys(posed.MRCAL_COUNTS, ("opencv", "lens")), to_camera=("rt_cam_ref",),
            hint="Run: mrcal-convert-lensmodel LENSMODEL_OPENCV8 FILE."), (2,)),
    "anipose": CalibrationFormat(
        "calibration.toml of anipose, Calib.toml of Pose2Sim (matrix, distortions)",
        r"\A(?=[\s\S]*^distortions[ \t]*=)[\s\S]*^matrix[ \t]*=",
        PosedCameras(posed.anipose_cameras, K="matrix", size="size", model="fisheye",
            lenses={False: ("opencv", "distortions"), True: ("fisheye", "distortions")},
            to_camera=("rotation translation",), is_asked=True, has_unit=False), uses_cameras=True),
    "okvis": CalibrationFormat(
        "settings of OKVIS (cameras, T_SC)", r"^[ \t]*-?[ \t]*\{?[ \t]*T_SC[ \t]*:",
        PosedCameras(posed.okvis_cameras, K="focal_length principal_point", size="image_dimension",
            lens="distortion_coefficients", model="distortion_type", to_world=("T_SC",)), uses_cameras=True),
    "svo": CalibrationFormat(
        "rig of SVO or maplab (cameras, T_B_C)",
        r"\A(?=[\s\S]*^[ \t-]*cameras[ \t]*:)[\s\S]*^[ \t-]*T_(B_C|C_B)[ \t]*:",
        PosedCameras(posed.svo_cameras, K="camera.intrinsics", size="camera.image_width camera.image_height",
            lens="camera.distortion.parameters", model="lens_model", to_world=("T_B_C",),
            to_camera=("T_C_B",)),
        uses_cameras=True),
    "stella": CalibrationFormat(
        "settings of stella_vslam (Camera, focal_x_baseline)",
        r"\A(?=[\s\S]*^[ \t]+(setup|focal_x_baseline)[ \t]*:)[\s\S]*^Camera[ \t]*:[ \t]*(#.*)?$",
        slam.read_stella),
    "airslam": CalibrationFormat(
        "settings of AirSLAM (cam0, T_type)", r"^[ \t]+T_type[ \t]*:",
        PosedCameras(posed.airslam_cameras, K="intrinsics", size="image_width image_height",
            model="distortion_type",
            lenses={0: ("opencv", ""), 1: ("opencv", "distortion_coeffs"), 2: ("fisheye", "fisheye_coeffs")},
            to_world=("T_body_cam",), to_camera=("T_cam_body",))),
    "stvo": CalibrationFormat(
        "settings of StVO-PL (cam0, cam_bl)", r"\A(?=[\s\S]*^cam0[ \t]*:)[\s\S]*^[ \t]+cam_bl[ \t]*:",
        slam.read_stvo),
    "ros_ini": CalibrationFormat(
        ".ini of ROS' camera_calibration ([image], camera matrix)", r"^camera matrix[ \t]*$",
        ros.read_ros_ini, (1, 2)),
    "vins": CalibrationFormat(
        "VINS-Fusion's configuration (cam0_calib, body_T_cam0)", r"^(cam0_calib|model_type)\s*:",
        PosedCameras(posed.vins_cameras, K="fx fy cx cy", size="image_width image_height", model="model_type",
            lenses={"PINHOLE": ("opencv", "k1 k2 p1 p2"), "KANNALA_BRANDT": ("fisheye", "k2 k3 k4 k5")},
            to_world=("body_T_cam",),
            hint="Calibrate with --camera-model pinhole or kannala-brandt, or pass Kalibr's camchain.yaml."),
        companions=posed.vins_files),
    "kalibr": CalibrationFormat(
        "Kalibr camchain.yaml (cam0)", r"^cam\d+:\s*(?:#.*)?$|^[ \t]+T_cn_cnm1[ \t]*:",
        PosedCameras(posed.kalibr_cameras, K="intrinsics", size="resolution", lens="distortion_coeffs",
            model="distortion_model", pose=posed.kalibr_pose), uses_cameras=True),
    "euroc": CalibrationFormat("pair of EuRoC sensor.yaml (T_BS)", r"^T_BS\s*:", posed.EUROC, (2,)),
    # Older settings also contain the rectification, with names that OpenCV's reader accepts.
    "orb_slam": CalibrationFormat(
        "ORB-SLAM's stereo settings (Camera1.fx, Camera.bf)",
        r"\A(?![\s\S]*^LEFT\.P[ \t]*:)[\s\S]*^(?:Camera1?\.fx|Camera\.bf)[ \t]*:", slam.read_orb_slam),
    "opencv": CalibrationFormat(
        "OpenCV YAML, XML or JSON (P1, P2, or M1, M2, R, T)",
        r'!!opencv-matrix|<opencv_storage|"opencv-matrix"', named.read_named, (1, 2, 3)),
    "ros": CalibrationFormat(
        "pair of ROS camera_info (projection_matrix)",
        r"^(projection_matrix|distortion_model|rectification_matrix)\s*:", ros.read_ros, (2,),
        one_is_enough=True),
    "stereodemo": CalibrationFormat(
        "stereodemo JSON, or lines of names and numbers (fx)",
        rf'{_json("fx")}|^[ \t]*fx[ \t]*[:=][ \t]*{_NUMBER}', stereo.read_stereodemo),
    "colmap": CalibrationFormat(
        "COLMAP model (cameras.txt and images.txt)", colmap.MARK, colmap.read_colmap, (2,), by_image=True,
        as_stored=True),
    # Any other JSON, and texts with names of cameras: the error then lists the missing names.
    "named": CalibrationFormat(
        "JSON, YAML, TOML or .npz of named matrices (K1, D1, K2, D2, R, T)",
        rf"\A\s*\{{|{_NAME_OF_CAMERA}", named.read_named, (1, 2, 3)),
}  # fmt: skip
