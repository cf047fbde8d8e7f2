"""``Message``: a sentence for the user with a code; ``MESSAGES`` says what each code means and what to do.

docs/reference/messages.md is made from this table.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class MessageKind:
    """What all messages of one code have in common."""

    title: str
    cause: str
    cure: str
    forbids_trust: bool = False  # a result with such a message is not trusted


class Message(str):
    """A sentence for the user, with the code of its kind: a key of ``MESSAGES``.

    It is a ``str``, so it prints, joins and compares like its sentence, and JSON holds the sentence; ``code``
    is for programs. What is made of it by methods of ``str``, or by ``+``, is plain text without a code.

    >>> [message.code for message in out.warnings]
    ['pose.refined']

    Raises:
        KeyError: a code that is not in the table.
    """

    __slots__ = ("_code",)
    _code: str

    def __new__(cls, code: str, text: str) -> Message:  # noqa: D102 - the class is documented
        if code not in MESSAGES:
            raise KeyError(f"{code!r} is no code of MESSAGES")
        message = super().__new__(cls, text)
        message._code = code
        return message

    def __getnewargs__(self) -> tuple[str, str]:  # type: ignore[override]  # copies and pickles keep the code
        return self._code, str(self)

    @property
    def code(self) -> str:
        """Key of ``MESSAGES``, such as ``"pose.inverse"``."""
        return self._code

    @property
    def forbids_trust(self) -> bool:
        """Whether a result with this message is not trusted."""
        return MESSAGES[self._code].forbids_trust

    def labelled(self, label: str) -> Message:
        """The message with ``label`` before its sentence."""
        return Message(self._code, label + self)

    def as_record(self) -> dict[str, Any]:
        """The message as reports have it in JSON."""
        return {"code": self._code, "text": str(self), "forbids_trust": self.forbids_trust}


def distinct(*groups: Iterable[Message]) -> tuple[Message, ...]:
    """The messages of all groups in order, each sentence once."""
    return tuple(dict.fromkeys(message for group in groups for message in group))


def as_records(*groups: Iterable[Message]) -> list[dict[str, Any]]:
    """The messages of all groups as reports have them in JSON, each sentence once."""
    return [message.as_record() for message in distinct(*groups)]


#: Group of codes (what stands before the dot) -> its heading on the page.
GROUPS = {
    "image": "Images",
    "camera": "Camera matrices",
    "calibration": "Calibration files",
    "baseline": "Baselines",
    "pose": "Given poses",
    "estimate": "Estimated poses",
    "scale": "The scale",
    "points": "Known points",
    "views": "The two views",
    "depth": "The depth",
    "prior": "The prior",
    "capture": "Captures",
    "pairs": "Many pairs",
    "config": "Configurations",
    "verdict": "The verdict",
}

MESSAGES: dict[str, MessageKind] = {
    "image.frames": MessageKind(
        "Only the first frame of the file is used",
        cause="The image file holds several frames or pages.",
        cure="Save the frame that you mean as a file of its own.",
    ),
    "image.dark": MessageKind(
        "A 16-bit image is nearly black",
        cause="The camera has 10 or 12 bits, and its values were stored without scaling.",
        cure="Multiply the values by 64 (10 bits) or 16 (12 bits).",
    ),
    "image.bits": MessageKind(
        "16-bit images of a bag are taken to be of fewer bits",
        cause="The camera has 10, 12 or 14 bits, and its driver stores the values as they come.",
        cure="Nothing. If the camera does have 16 bits, the scene was dark.",
    ),
    "image.alpha": MessageKind(
        "The alpha channel is dropped",
        cause="The image has four channels.",
        cure="Nothing, unless transparent pixels hold colours that do not belong to the scene.",
    ),
    "image.turned": MessageKind(
        "The image was turned as its EXIF says",
        cause="The camera stored the image in another orientation, with a note of it.",
        cure="Give the K of the upright image.",
    ),
    "image.orientation": MessageKind(
        "An EXIF orientation is not applied",
        cause="An image from memory is taken as it lies there.",
        cure="Call PIL.ImageOps.exif_transpose first, and give the K of the upright image.",
    ),
    "camera.from-exif": MessageKind(
        "K comes from the EXIF of the photograph",
        cause="Neither K nor a field of view was given.",
        cure="Nothing if a few per cent are exact enough; otherwise calibrate the camera.",
    ),
    "camera.filled-in": MessageKind(
        "Numbers of the camera are assumed",
        cause="Only a focal length was given.",
        cure="Give fy, cx and cy of a calibration (--fy, --cx, --cy).",
    ),
    "camera.zoom": MessageKind(
        "The photograph was zoomed digitally",
        cause="Some cameras do not count a digital zoom in the focal length of their EXIF.",
        cure="Take the photograph without zoom, or give K.",
    ),
    "camera.same-centre": MessageKind(
        "The right camera's cx is assumed to be the left one's",
        cause="Only one K was given for two parallel cameras.",
        cure="Give the right camera's matrix (K_right, --K-right) or its cx (--cx-right).",
    ),
    "camera.other-centre": MessageKind(
        "The right camera's cx is not the left one's",
        cause="Only one K was given for two parallel cameras, and under it things lie behind infinity.",
        cure="Give the right camera's matrix (K_right, --K-right) or its cx (--cx-right). If both are alike, "
        "check E and the right image.",
        forbids_trust=True,
    ),
    "camera.principal-point": MessageKind(
        "The principal point is at an unusual place",
        cause="K belongs to an image of another size.",
        cure="Scale K with the image; for a crop say so (cropped=True, --cropped).",
        forbids_trust=True,
    ),
    "camera.stretched": MessageKind(
        "fx and fy differ by more than a factor of two",
        cause="A digit of one of them is mistyped, or the image was stretched.",
        cure="Check both focal lengths.",
    ),
    "camera.other-lens": MessageKind(
        "The focal length contradicts the EXIF of the photograph",
        cause="K is for an image of another size or of another lens.",
        cure="Check the image size that K was calibrated for, and scale K.",
    ),
    "camera.field-of-view": MessageKind(
        "The field of view is unusual",
        cause="K is for an image of another size; or the lens is a telephoto or a fisheye.",
        cure="Check K. If the lens is as K says, ignore the message.",
    ),
    "camera.swapped": MessageKind(
        "The camera matrices seem to be exchanged",
        cause="K was given as (K_right, K_left).",
        cure="Give K as (K_left, K_right).",
        forbids_trust=True,
    ),
    "camera.scaled": MessageKind(
        "K seems to be for images of another size",
        cause="The images were resized, and K was not.",
        cure="Scale K as the message says.",
        forbids_trust=True,
    ),
    "camera.focal-scaled": MessageKind(
        "The focal lengths seem to be for images of another size",
        cause="The images were resized; only the principal point of K belongs to the new size.",
        cure="Scale fx and fy as the message says.",
        forbids_trust=True,
    ),
    "calibration.no-unit": MessageKind(
        "The calibration has no unit",
        cause="Models of structure from motion have no known scale.",
        cure="Give the measured distance between the cameras (baseline_m, --baseline).",
    ),
    "calibration.assumed-metres": MessageKind(
        "The calibration's unit is assumed to be metres",
        cause="The file does not say its unit, and its cameras would stand further apart than 1.5 m.",
        cure="Give the measured distance between the cameras (baseline_m, --baseline), or name the unit in "
        "the file, as in translation_mm.",
        forbids_trust=True,
    ),
    "calibration.as-taken": MessageKind(
        "The pictures are used as unrectified ones",
        cause="The calibration describes pictures as taken and rectified ones, and matches fit the former.",
        cure="Nothing; if the pictures are rectified, give a file of P1 and P2 alone.",
    ),
    "calibration.doffs": MessageKind(
        "The right cx of a Middlebury file contradicts doffs",
        cause="cam1 is missing, or differs from cx0 + doffs, which the ground truth was made with.",
        cure="Nothing if the file is as published; otherwise correct doffs or cam1.",
    ),
    "calibration.assumed-lens": MessageKind(
        "The lens of SceneFlow's images is assumed",
        cause="Its camera_data.txt has no intrinsics, and the folder's name does not say the lens.",
        cure="Nothing for 35 mm; else keep Driving's folder 15mm_focallength in the path.",
    ),
    "calibration.kitti-cameras": MessageKind(
        "KITTI's colour cameras are taken",
        cause="The calibration holds a grey and a colour pair, and nothing says which is meant.",
        cure="Give the cameras (cameras, --cameras).",
    ),
    "baseline.long": MessageKind(
        "The baseline is longer than 20 m",
        cause="The translation is in millimetres.",
        cure="Divide E[:3, 3], or the baseline, by 1000. If it is in metres, give the range of the scene "
        "(depth_range, --near, --far).",
        forbids_trust=True,
    ),
    "baseline.short": MessageKind(
        "The baseline is shorter than a millimetre",
        cause="The translation was divided by 1000 once too often.",
        cure="Give baselines and poses in metres.",
        forbids_trust=True,
    ),
    "pose.inverse": MessageKind(
        "The inverse pose fits better",
        cause="Left and right are swapped, the baseline has the wrong sign, or E is world-to-camera.",
        cure="Exchange the images, change the sign, or invert E.",
        forbids_trust=True,
    ),
    "pose.opengl": MessageKind(
        "The pose seems to be in the axes of OpenGL",
        cause="OpenGL and Blender have y up and z backward.",
        cure="Give diag(1, -1, -1, 1) @ E @ diag(1, -1, -1, 1).",
        forbids_trust=True,
    ),
    "pose.opengl-inverse": MessageKind(
        "The pose seems to be world-to-camera, in the axes of OpenGL",
        cause="OpenGL and Blender have y up and z backward, and E is inverted.",
        cure="Give inv(diag(1, -1, -1, 1) @ E @ diag(1, -1, -1, 1)).",
        forbids_trust=True,
    ),
    "pose.transposed": MessageKind(
        "The rotation seems to be transposed",
        cause="Rows and columns of the rotation are exchanged.",
        cure="Give E with E[:3, :3] transposed.",
        forbids_trust=True,
    ),
    "pose.mixed": MessageKind(
        "Rotation and translation are of inverse poses",
        cause="E combines the rotation of camera-to-world with the translation of world-to-camera.",
        cure="Take both from the camera-to-world pose: its translation is the camera's position.",
        forbids_trust=True,
    ),
    "pose.unit": MessageKind(
        "Baseline and scene are implausibly large",
        cause="The baseline or the translation is in centimetres or millimetres.",
        cure="Divide it by 100 or 1000. If the scene is as far away as that, give its range in metres "
        "(depth_range, --near, --far).",
        forbids_trust=True,
    ),
    "pose.refined": MessageKind(
        "The given pose was off by more than a pixel and was refined",
        cause="Poses of trackers, of SLAM or of a rig that has drifted are inexact.",
        cure="Nothing if the refined residual is below a pixel; otherwise see the causes in the message.",
    ),
    "pose.kept": MessageKind(
        "The given pose is off by more than a pixel, and no pose near it is better",
        cause="K, the lens or the order of the views is wrong, or things moved between the photographs.",
        cure="Check these in the order in which the message names them.",
    ),
    "pose.too-far": MessageKind(
        "The pose that fits is too far from the given one and was not used",
        cause="The given pose is that of another pair, or of another convention.",
        cure="Correct the pose, or have it estimated (from_photographs, --estimate-pose).",
    ),
    "pose.undetermined": MessageKind(
        "The matches do not determine the pose",
        cause="The cameras stood close together, or few things match: a turn and a step look alike.",
        cure="Give a more exact pose, or views from further apart.",
        forbids_trust=True,
    ),
    "pose.few-matches": MessageKind(
        "The pose was refined, or kept, where hardly any features match",
        cause="The pose misses what optical flow finds, and there are too few features to say by how much.",
        cure="Give a more exact pose, or views that show more texture or overlap more.",
        forbids_trust=True,
    ),
    "pose.unchecked": MessageKind(
        "Nothing shows whether the pose is right",
        cause="There are too few matches to check it, and the depth does not confirm it either.",
        cure="Give views that show more texture or overlap more; or pose='given' for a pose that is exact.",
        forbids_trust=True,
    ),
    "pose.residual": MessageKind(
        "Matches lie 2 to 4 px off their epipolar lines",
        cause="The images are not quite rectified, the lens is not corrected, or the pose is inexact.",
        cure="Rectify the images, correct the lens, or check K and the pose.",
    ),
    "pose.off-lines": MessageKind(
        "Matches lie more than 4 px off their epipolar lines",
        cause="The pair is not rectified, K is for other images, or E is of another pair.",
        cure="Check these in this order.",
        forbids_trust=True,
    ),
    "estimate.second-motion": MessageKind(
        "A part of the scene moved",
        cause="Something moved between the photographs, or a pattern repeats.",
        cure="Take both photographs at one moment, or of a scene that stands still.",
    ),
    "estimate.parallax": MessageKind(
        "There is little parallax",
        cause="The camera hardly moved to the side.",
        cure="Step to the side by a twentieth to a fifth of the distance to what you measure.",
    ),
    "estimate.plane": MessageKind(
        "Nearly all matches lie on one plane",
        cause="The photographs show a wall, a floor or a poster.",
        cure="Show things at different depths, or give the pose.",
    ),
    "estimate.undetermined": MessageKind(
        "The matches do not determine the estimated pose",
        cause="The photographs show little texture, or are close together.",
        cure="Take others, or give the pose.",
    ),
    "scale.none": MessageKind(
        "No length is known",
        cause="Two photographs without a measured length have no unit.",
        cure="Give the distance between the cameras, a known length, or known points.",
    ),
    "scale.from-prior": MessageKind(
        "The metres are the prior's own",
        cause="No length is known, and the prior is metric.",
        cure="Give a length for metres that do not depend on the prior.",
    ),
    "scale.uncertain": MessageKind(
        "The scale of the refined pose is uncertain",
        cause="The baseline and the depth of the scene under the given pose disagree.",
        cure="Give the measured distance between the cameras, or at least three known points.",
        forbids_trust=True,
    ),
    "points.far": MessageKind(
        "The known depths look like millimetres",
        cause="All of them are far away, or they are large whole numbers.",
        cure="Divide them by 1000, or give their scale (scale=1000, --points-scale 1000).",
        forbids_trust=True,
    ),
    "points.outside": MessageKind(
        "Points outside the left image are left out",
        cause="The points are of a larger scene, or in another camera's frame.",
        cure="Give points in the left camera's frame, in metres.",
    ),
    "points.few": MessageKind(
        "Known depths are too few to rely on",
        cause="Fewer than three lie in the image.",
        cure="Give at least three points.",
    ),
    "points.too-few": MessageKind(
        "Known depths are too few to fix scale and shift",
        cause="Fewer than three lie in the image, and there is no second view that could be matched.",
        cure="Give at least three points.",
        forbids_trust=True,
    ),
    "points.differ": MessageKind(
        "Points and matches differ by a factor of up to 1.2",
        cause="The baseline, K, or the unit or the frame of the points is inexact.",
        cure="Check the unit of the points, the baseline and K.",
    ),
    "points.factor": MessageKind(
        "Points and matches differ by a large factor",
        cause="A unit, the baseline or K is wrong, or the points are in another frame.",
        cure="Check the unit of the points, the baseline and K.",
        forbids_trust=True,
    ),
    "points.some-contradict": MessageKind(
        "A quarter of the known depths or more contradict the matches",
        cause="The points are noisy, at edges, or seen by the sensor alone.",
        cure="Give them a confidence (points_confidence, --points-confidence), or leave them out.",
    ),
    "points.contradict": MessageKind(
        "More than half of the known depths contradict the matches",
        cause="The points are noisy, or of another scene or moment.",
        cure="Give them a confidence (points_confidence, --points-confidence), or leave them out.",
        forbids_trust=True,
    ),
    "views.same": MessageKind(
        "Left and right are the same picture",
        cause="One file was given twice.",
        cure="Give two photographs from two places.",
        forbids_trust=True,
    ),
    "views.shifted": MessageKind(
        "All matches have one depth",
        cause="The right image is a shifted copy of the left one, or the scene is a flat wall seen head-on.",
        cure="Give a second photograph from another place.",
        forbids_trust=True,
    ),
    "views.disagree": MessageKind(
        "The views hardly agree",
        cause="The axis or the rotation of E is wrong, the images are not rectified or not free of lens "
        "distortion, K is of another size, one image is mirrored, or they show different scenes or moments.",
        cure="Check these in this order; overview.png shows where the views disagree.",
        forbids_trust=True,
    ),
    "views.behind-infinity": MessageKind(
        "Matches lie behind infinity",
        cause="cx of the right camera is not what K says, the rotation of E is wrong, the right image was "
        "cropped or stretched, or things moved between the photographs.",
        cure="Give the right camera's own K (K_right, --K-right, --cx-right); check E and the right image.",
        forbids_trust=True,
    ),
    "views.distorted": MessageKind(
        "The pictures are not free of lens distortion",
        cause="They are the camera's own, and the calibration comes without its distortion; or they were "
        "rectified already, and the calibration comes with it.",
        cure="Rectify the pictures once, or give the camera's own with a calibration that holds the "
        "distortion.",
        forbids_trust=True,
    ),
    "views.bent": MessageKind(
        "Residuals change over the pictures",
        cause="E has a wrong rotation, the right picture is sheared by a rolling shutter, or lens distortion "
        "was not removed: the matches fit each of them.",
        cure="Check the rotation in E, and that the pictures are rectified with this calibration.",
        forbids_trust=True,
    ),
    "views.sheared": MessageKind(
        "Upright lines lean in the right picture",
        cause="A rolling shutter read its rows out one after the other while the camera or the scene moved.",
        cure="Use a camera with a global shutter, or hold everything still.",
        forbids_trust=True,
    ),
    "views.torn": MessageKind(
        "A picture is torn",
        cause="A frame was read out while the next one replaced it, or lines of it were lost.",
        cure="Take another frame; synchronise read-out and exposure.",
        forbids_trust=True,
    ),
    "views.moved": MessageKind(
        "A part of the pictures moved between them",
        cause="The pictures were not taken at one moment, and something moved.",
        cure="Take both at one moment, or of a scene that stands still.",
        forbids_trust=True,
    ),
    "views.bars": MessageKind(
        "Bars of one colour lie at opposite sides of the pictures",
        cause="The pictures were fitted into another format.",
        cure="Cut the bars off and give the K of what is left. If K is of the pictures with bars, ignore the "
        "message.",
    ),
    "views.overlap": MessageKind(
        "The views overlap little",
        cause="A small share of the left image is seen by a right camera.",
        cure="Choose views that overlap by half or more.",
    ),
    "depth.exchanged": MessageKind(
        "Near and far are exchanged",
        cause="Left and right are swapped, the sign of the baseline is wrong, E is world-to-camera, or a "
        "prior map is of another space.",
        cure="Exchange the images, change the sign, invert E, or name the space of the map (--space).",
        forbids_trust=True,
    ),
    "depth.occlusion": MessageKind(
        "What is matched as far hides what is near",
        cause="Left and right are swapped, or both pictures are mirrored or upside down, and the principal "
        "points of the cameras differ.",
        cure="Exchange the images, or turn them as the cameras took them.",
        forbids_trust=True,
    ),
    "depth.order": MessageKind(
        "Prior and matches hardly agree on near and far",
        cause="E, K or the order of the images is wrong, or the right image shows something else.",
        cure="Check these in this order.",
        forbids_trust=True,
    ),
    "depth.order-points": MessageKind(
        "Prior and known depths disagree on near and far",
        cause="The points are not metres along z in the left camera's frame, or the space of the prior is "
        "wrong.",
        cure="Check the frame and the unit of the points, and the space of the prior.",
        forbids_trust=True,
    ),
    "depth.range": MessageKind(
        "The scene reaches beyond the given range of depths",
        cause="depth_range (--near, --far) is too narrow.",
        cure="Widen it, or leave it out.",
        forbids_trust=True,
    ),
    "depth.off-matches": MessageKind(
        "The depth differs from what both views match",
        cause="The scale or the shift was not found.",
        cure="Leave corrections and updates on, use another prior, or give known points.",
        forbids_trust=True,
    ),
    "depth.search-edge": MessageKind(
        "The search for the scale ended at the edge of its range",
        cause="The depth may lie beyond the range of the search.",
        cure="Check the unit of the baseline, or widen depth_range (--near, --far).",
    ),
    "prior.order": MessageKind(
        "The prior takes near for far, and the matches show that it is wrong",
        cause="The prior does not know such scenes; or the given map is of another picture, turned, or of "
        "another space.",
        cure="Check the map and its space (--space). Otherwise nothing where things are matched; elsewhere "
        "the depth follows the prior and has a low confidence.",
    ),
    "prior.metres": MessageKind(
        "The depth is far from the prior's own metres",
        cause="The baseline is not in metres, K is of another image size, or the prior does not know such "
        "scenes.",
        cure="Check the baseline and K. If the prior was trained on other scenes, ignore the message.",
    ),
    "prior.unit": MessageKind(
        "The depth is more than 20 times the prior's own metres, or less than a twentieth",
        cause="The baseline is not in metres.",
        cure="Check the unit of the baseline. If it is right, give the range of the scene in metres "
        "(depth_range, --near, --far), or use another prior.",
        forbids_trust=True,
    ),
    "prior.one-member": MessageKind(
        "Only one member of the ensemble runs",
        cause="The prior gives the same map every time.",
        cure="Leave ensemble_size (--ensemble) at 1 with this prior.",
    ),
    "capture.skipped": MessageKind(
        "Frames are skipped",
        cause="A frame has no image file, no pose, or a camera that cannot be used; the message says which.",
        cure="Nothing if the others suffice.",
    ),
    "capture.part": MessageKind(
        "A part of what the folder holds is read",
        cause="It has several models, splits or cameras, of which one is taken.",
        cure="Name the file or folder of another one to take that.",
    ),
    "capture.images-found": MessageKind(
        "Images were found elsewhere than the file of cameras says",
        cause="They lie in none of the usual folders; files of their names lie near it.",
        cure="Check that they are the right ones; if not, give their folder (--images).",
    ),
    "capture.poses-beside": MessageKind(
        "Images are read without poses, though there may be some",
        cause="Beside them lies a file of another program's cameras, or a folder that looks like a capture.",
        cure="Give the file or folder that the message names, or convert it as it says.",
    ),
    "capture.no-poses": MessageKind(
        "The file of cameras has no pose of any frame",
        cause="It was written before its images were placed.",
        cure="Nothing: the poses are solved for. To keep the program's own, export them after alignment.",
    ),
    "capture.other-size": MessageKind(
        "Images are nearly, but not quite, of the size of their cameras",
        cause="They are other pictures: those before lens distortion was removed, or of another export.",
        cure="Say where the images lie that the cameras are of (--images), or give the model of these.",
        forbids_trust=True,
    ),
    "capture.assumed-metres": MessageKind(
        "The lengths of a transforms.json are taken as metres",
        cause="It names no unit, and no depth maps, which come from devices that measure in metres.",
        cure="Nothing if they are metres. If its poses were solved from the images, or it was rendered in "
        "another unit, give a length (--known-length, --distance, --metres-per-unit).",
    ),
    "capture.gps-scale": MessageKind(
        "The capture was aligned with GPS",
        cause="OpenSfM fitted its reconstruction to positions that are exact to some metres.",
        cure="Give --metres-per-unit 1 to take its lengths as metres, or a length that you measured.",
    ),
    "capture.stored-pixels": MessageKind(
        "The EXIF orientation of frames is not applied",
        cause="The cameras of the capture are those of the pixels as the image files store them.",
        cure="Nothing: depth comes out in the stored pixels too.",
    ),
    "capture.assumed-k": MessageKind(
        "K of the data set's cameras is assumed",
        cause="7-Scenes and TUM RGB-D come without a calibration file.",
        cure="Give K (--K) for other cameras.",
    ),
    "capture.no-trajectory": MessageKind(
        "The poses of the video are estimated, without a unit",
        cause="No trajectory was given.",
        cure="Give one (--trajectory), or a length (--known-length, --distance).",
    ),
    "capture.blurred": MessageKind(
        "Frames are blurred or without texture",
        cause="They have few features.",
        cure="Nothing: no other frame relies on them. Move the camera slower for the next capture.",
    ),
    "capture.no-matches": MessageKind(
        "No two frames match",
        cause="The frames are not of one scene, or not sharp.",
        cure="Record them again, with overlap.",
    ),
    "capture.convention": MessageKind(
        "The poses are read in another convention than written",
        cause="The matches contradict the poses as written.",
        cure="Nothing if the convention that the message names is right.",
    ),
    "capture.convention-unsure": MessageKind(
        "The convention of the poses is not known",
        cause="None fits the matches: under the one that fits best they lie far off their epipolar lines.",
        cure="Give camera-to-world poses of these pictures, in the axes of OpenCV or OpenGL.",
        forbids_trust=True,
    ),
    "capture.turned": MessageKind(
        "The pictures are turned against their cameras",
        cause="They are stored in another orientation than the one that the poses and K are for, or were "
        "turned since.",
        cure="Turn the pictures as the message says, or give poses and K of the pictures as they are stored.",
        forbids_trust=True,
    ),
    "capture.focal": MessageKind(
        "The focal length that fits best is far from the given one",
        cause="K is of another image size, or the motion does not determine the focal length.",
        cure="Check K; the given one is used.",
    ),
    "capture.kept": MessageKind(
        "The given poses fit as well as any",
        cause="They are exact.",
        cure="Nothing.",
    ),
    "capture.scales": MessageKind(
        "Positions and depth give different scales",
        cause="The tracker's lengths are inexact.",
        cure="Give a known length (--known-length).",
    ),
    "capture.scale": MessageKind(
        "The scale of the capture is uncertain",
        cause="Its estimates vary from frame to frame, or trajectory and depth of the scene disagree.",
        cure="Give a known length (--known-length) or a distance (--distance).",
        forbids_trust=True,
    ),
    "capture.length": MessageKind(
        "The known length is not measured well in its frame",
        cause="An end of --known-length lies where the depth of the frame is uncertain: without texture, on "
        "an edge, or seen by no other frame.",
        cure="Choose other ends, or give a distance (--distance).",
        forbids_trust=True,
    ),
    "capture.wrong-poses": MessageKind(
        "Given poses of some frames are wrong",
        cause="The tracker jumped.",
        cure="Nothing: the solved poses are used.",
    ),
    "capture.unconnected": MessageKind(
        "Frames are not connected to the others",
        cause="They share too few points with others, or fit worse when moved.",
        cure="Nothing if the rest suffices; record with more overlap otherwise.",
    ),
    "capture.parts": MessageKind(
        "The capture falls into parts",
        cause="No frames connect them.",
        cure="Record frames between the parts, or process them one by one.",
    ),
    "capture.no-video": MessageKind(
        "The video was not written",
        cause="OpenCV has no codec for it here.",
        cure="Nothing: everything else is written. Install an OpenCV with codecs for the video.",
    ),
    "pairs.in-order": MessageKind(
        "Images of two folders are paired in order",
        cause="The folders share no file name.",
        cure="Check the first and the last pair that the message names. If they are wrong, give both images "
        "of a pair one name.",
    ),
    "pairs.side-by-side": MessageKind(
        "The video is taken to hold both views side by side",
        cause="One video was given.",
        cure="Give both videos if it holds the left view alone.",
    ),
    "config.former-knobs": MessageKind(
        "Knobs of a former version are left out",
        cause="The configuration was saved by a version that had them.",
        cure="Save the configuration again.",
    ),
    "verdict.not-trusted": MessageKind(
        "Do not trust this depth",
        cause="At least one message that forbids trust; the sentence holds all of them.",
        cure="Each of its reasons has an entry here.",
    ),
    "verdict.not-judged": MessageKind(
        "This depth was not judged",
        cause="Neither matches of two views nor enough known depths, all over the image, test it.",
        cure="Give a second view that overlaps, or at least 50 points spread over the image.",
    ),
}
