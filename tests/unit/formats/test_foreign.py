"""Known but unsupported calibration formats."""

import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import foreign


def test_only_the_beginning_of_a_file_is_searched(tmp_path):
    file = tmp_path / "c.yaml"
    mark = "camera.A=[1 2 3]\n"
    for blanks, is_seen in ((0, True), (4096 - len(mark) - 1, True), (4097, False)):
        file.write_text(" " * blanks + "\n" + mark)
        if not is_seen:
            foreign.refuse_foreign_calibration(file)
            continue
        with pytest.raises(
            InputError,
            match=r"\Acalibration must be in a format that is read; got .*c\.yaml, parameters "
            r"of an rc_visard or of cvkit\. Give --fx .*--baseline\.\Z",
        ):
            foreign.refuse_foreign_calibration(file)


def test_missing_files_and_folders_are_not_refused_here(tmp_path):
    foreign.refuse_foreign_calibration(tmp_path / "none.yaml")
    foreign.refuse_foreign_calibration(tmp_path)


#: An example of each format, by the first words of its name.
BEGINNINGS = {
    "a list of the calibration's pictures": '<images> "a.png"',
    "a camera.txt of DSO": "\nEquiDistant 0.5 0.6",
    "a .mat of MATLAB (or HDF5)": "\x89HDF\r\n",
    "pickled objects": "\x80\x03abc",
    "a single array": "\x93NUMPY",
    "a .cam of MPI Sintel": "PIEH",
    "Kalibr's results as text": "x\n Camera-system parameters:\n",
    "a lens of Metashape": "<calibration>\n<projection>frame",
    "a camera of VINS-Fusion": "%YAML:1.0\nmodel_type: MEI\n",
    "a RealSense without its calibration": "x\nDevice info :",
    "a rig of cuVSLAM": '[{"intrinsics": {"distortion_model": "x"}, "transform": 1}]',
    "the calibration of an Azure Kinect": '{"CalibrationInformation": 1}',
    "cameras of the Panoptic Studio": '{"calibDataSource": 1}',
    "a camera of XRPrimer": '{"class_name": "x", "extrinsic_r": 1}',
    "cameras of a vehicle's frame": '{"extrinsics": [{"rotation": 1}]}',
    "a camera of the Ames Stereo Pipeline": "fu = 3\nu_direction = 1 0 0",
    "a sequence of RealEstate10K": "https://a.b/c\n123" + " 0.5" * 18,
    "a reconstruction of many images": "NVM_V3 \n",
    "a cam_to_cam.yaml of DSEC": "disparity_to_depth:\n",
    "parameters of an rc_visard": "camera.A=[1]",
    "a camera of Open3D": '{"intrinsic_matrix": []}',
}


def test_every_foreign_format_has_an_example():
    assert len(BEGINNINGS) == len(foreign.FOREIGN_CALIBRATIONS)


def test_foreign_formats_are_refused_with_name_and_hint(tmp_path):
    file = tmp_path / "c.dat"
    for each in foreign.FOREIGN_CALIBRATIONS:
        (beginning,) = [text for name, text in BEGINNINGS.items() if each.name.startswith(name)]
        file.write_bytes(beginning.encode("latin-1"))
        with pytest.raises(InputError) as caught:
            foreign.refuse_foreign_calibration(file)
        expected = f"calibration must be in a format that is read; got {file}, {each.name}. {each.cure}"
        assert str(caught.value) == expected
        assert not each.name.endswith(".") and each.cure.endswith((".", ")"))  # not exchanged
