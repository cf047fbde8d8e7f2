"""Defines ``Finding``: a message for the user with a code and a severity.

``FINDINGS`` lists the kinds of findings that readers and jobs report. The checks of a result declare their
own kinds (``geodiff_plugin.trust``). docs/reference/messages.md is generated from both.

Layer 0: imports nothing; everything above imports it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

#: Maximum number of names that a message lists.
MAX_NAMES = 5
#: Maximum number of characters of a name in a message, because a file may contain a name of any length.
MAX_NAME_LENGTH = 60


class Severity(Enum):
    """How a finding affects a result."""

    REASON = "reason"  # the result is not trusted
    REMARK = "remark"  # unusual, but possibly correct
    ASSUMPTION = "assumption"  # the result depends on an assumption that was not verified
    WARNING = "warning"  # other information about the input, its handling, or the output


REASON, REMARK = Severity.REASON, Severity.REMARK
ASSUMPTION, WARNING = Severity.ASSUMPTION, Severity.WARNING


@dataclass(frozen=True)
class FindingKind:
    """Title, cause and hint that all findings with one code share."""

    code: str
    severity: Severity
    title: str
    cause: str
    hint: str
    explains: tuple[str, ...] = ()  # codes of reasons that it suppresses; "*" for all


class Finding(str):
    """A message for the user that also has a code and a severity.

    A finding is a ``str`` and prints, joins and compares like its text. Programs use ``code`` and
    ``severity``. The results of ``str`` methods and of ``+`` are plain strings without a code.

    >>> [finding.code for finding in out.findings if finding.severity is Severity.WARNING]
    ['pose.refined']

    Raises:
        KeyError: The code is not in ``FINDINGS``.
    """

    __slots__ = ("_kind",)
    _kind: FindingKind

    def __new__(cls, kind: FindingKind | str, text: str) -> Finding:  # noqa: D102 - the class is documented
        if isinstance(kind, str) and kind not in FINDINGS:
            raise KeyError(f"{kind!r} is not a code in FINDINGS")
        finding = super().__new__(cls, text)
        finding._kind = FINDINGS[kind] if isinstance(kind, str) else kind
        return finding

    def __getnewargs__(self) -> tuple[FindingKind, str]:  # type: ignore[override]  # for copies and pickles
        return self._kind, str(self)

    @property
    def kind(self) -> FindingKind:
        """The declaration of this code: title, cause and hint."""
        return self._kind

    @property
    def code(self) -> str:
        """The code, such as ``"depth.inverted-order"``."""
        return self._kind.code

    @property
    def severity(self) -> Severity:
        """How the finding affects the result."""
        return self._kind.severity

    @property
    def is_reason(self) -> bool:
        """Whether a result with this finding is not trusted."""
        return self._kind.severity is REASON

    def labelled(self, label: str) -> Finding:
        """Return the finding with ``label`` prepended to its text."""
        return Finding(self._kind, label + self)

    def as_record(self) -> dict[str, Any]:
        """Return the finding as a JSON record of a report."""
        return {"code": self.code, "severity": self.severity.value, "text": str(self)}


def some_names(names: Sequence[str]) -> str:
    """Join the first ``MAX_NAMES`` names and append the number of the others."""
    shown = (
        name if len(name) <= MAX_NAME_LENGTH else f"{name[:MAX_NAME_LENGTH]}..." for name in names[:MAX_NAMES]
    )
    more = f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    return ", ".join(shown) + more


def dedupe(*groups: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings of all groups in order, without duplicate texts."""
    return tuple(dict.fromkeys(finding for group in groups for finding in group))


def as_records(*groups: Iterable[Finding]) -> list[dict[str, Any]]:
    """Return the findings of all groups as JSON records, without duplicate texts."""
    return [finding.as_record() for finding in dedupe(*groups)]


#: Prefix of the codes of a group (the part before the dot) -> heading of the group on the page.
GROUPS = {
    "image": "Images",
    "camera": "Camera matrices",
    "calibration": "Calibration files",
    "baseline": "Baselines",
    "pose": "Given poses",
    "estimate": "Estimated poses",
    "scale": "Scale",
    "points": "Known points",
    "views": "Image pairs",
    "depth": "Depth",
    "prior": "Priors",
    "capture": "Captures",
    "pairs": "Batches of pairs",
    "config": "Configurations",
    "verdict": "Verdict",
}

_KINDS = (
    FindingKind(
        "image.frames",
        WARNING,
        "Only the first frame of the image file is used",
        cause="The image file holds several frames or pages.",
        hint="Save the frame you need as a separate file.",
    ),
    FindingKind(
        "image.dark",
        WARNING,
        "A 16-bit image is nearly black",
        cause="The camera records 10 or 12 bits, and the values were stored without scaling to 16 bits.",
        hint="Multiply the values by 64 (10 bits) or 16 (12 bits).",
    ),
    FindingKind(
        "image.bits",
        WARNING,
        "The 16-bit images in a bag are treated as 10-, 12- or 14-bit images",
        cause="The camera records 10, 12 or 14 bits, and its driver stores the values without scaling.",
        hint="Ignore this warning unless the camera records 16 bits and the scene was dark. In that case, "
        "the images appear too bright.",
    ),
    FindingKind(
        "image.alpha",
        WARNING,
        "Fully transparent pixels (alpha 0) are treated as invalid",
        cause="The image has four channels.",
        hint="Remove the alpha channel if those pixels contain scene content.",
    ),
    FindingKind(
        "image.rotated",
        WARNING,
        "The image was rotated according to its EXIF orientation",
        cause="The camera stored the image unrotated and recorded its orientation in EXIF.",
        hint="Pass K for the upright image.",
    ),
    FindingKind(
        "image.orientation",
        WARNING,
        "The EXIF orientation is not applied",
        cause="In-memory images are used as is.",
        hint="Call PIL.ImageOps.exif_transpose first, and pass K for the upright image.",
    ),
    FindingKind(
        "camera.from-exif",
        ASSUMPTION,
        "K is estimated from the EXIF focal length",
        cause="Neither K nor a field of view was specified.",
        hint="Ignore this if an error of a few percent is acceptable; otherwise calibrate the camera.",
    ),
    FindingKind(
        "camera.from-list",
        ASSUMPTION,
        "The focal length is the manufacturer's value for the camera selected in the web app",
        cause="The image files have no EXIF focal length.",
        hint="Use images with EXIF data, or calibrate the camera.",
    ),
    FindingKind(
        "camera.from-fov",
        ASSUMPTION,
        "The field of view was entered in the web app",
        cause="The image files have no EXIF focal length.",
        hint="Use images with EXIF data, or calibrate the camera.",
    ),
    FindingKind(
        "camera.assumed-intrinsics",
        ASSUMPTION,
        "Missing intrinsics are set to default values",
        cause="Only a focal length was specified.",
        hint="Set the calibrated fy, cx and cy (--fy, --cx, --cy).",
    ),
    FindingKind(
        "camera.zoom",
        WARNING,
        "The image was taken with digital zoom",
        cause="The EXIF data record digital zoom, which some cameras do not include in the focal length.",
        hint="Retake the image without digital zoom, or provide K.",
    ),
    FindingKind(
        "camera.assumed-cx",
        ASSUMPTION,
        "The right camera's cx is assumed to equal the left camera's",
        cause="Only one K was passed for two parallel cameras.",
        hint="Pass the right camera's matrix (K_right, --K-right) or its cx (--cx-right).",
    ),
    FindingKind(
        "camera.principal-point",
        REASON,
        "The principal point is far from the image centre",
        cause="K is for a different image size.",
        hint="Scale K to this image size. If the image is cropped, set cropped=True (--cropped).",
    ),
    FindingKind(
        "camera.aspect-ratio",
        WARNING,
        "fx and fy differ by more than a factor of two",
        cause="One of them has a mistyped digit, or the image was stretched.",
        hint="Check both focal lengths.",
    ),
    FindingKind(
        "camera.focal-mismatch",
        WARNING,
        "The focal length in K contradicts the EXIF focal length",
        cause="K is for a different image size or a different lens.",
        hint="Check the image size that K was calibrated for, and scale K.",
    ),
    FindingKind(
        "calibration.no-unit",
        WARNING,
        "The calibration has no unit of length",
        cause="The scale of a structure-from-motion model is unknown.",
        hint="Specify the measured baseline (baseline_m, --baseline).",
    ),
    FindingKind(
        "calibration.assumed-metres",
        REASON,
        "The calibration's unit is assumed to be metres",
        cause="The file states no unit. If it is in metres, the baseline is longer than 1.5 m, which is "
        "unusual.",
        hint="Specify the measured baseline (baseline_m, --baseline), or rename the translation field in the "
        "file to include its unit, for example translation_mm.",
    ),
    FindingKind(
        "calibration.unrectified",
        WARNING,
        "The images are treated as unrectified",
        cause="The calibration describes both raw and rectified images, and the matches fit raw images.",
        hint="If the images are rectified, pass a file that contains only P1 and P2.",
    ),
    FindingKind(
        "calibration.doffs",
        WARNING,
        "For a Middlebury file, the right cx is computed as cx0 + doffs",
        cause="cam1 is missing, or its cx differs from cx0 + doffs, on which the ground truth is based.",
        hint="Ignore this warning if the file is the published one; otherwise correct doffs or cam1.",
    ),
    FindingKind(
        "calibration.assumed-lens",
        WARNING,
        "The focal length of SceneFlow images is assumed",
        cause="camera_data.txt has no intrinsics, and the folder name does not state the lens.",
        hint="Ignore this warning if the lens is 35 mm. For Driving's 15 mm images, keep the folder name "
        "15mm_focallength in the path.",
    ),
    FindingKind(
        "calibration.kitti-cameras",
        WARNING,
        "KITTI's colour cameras are used",
        cause="The calibration holds a greyscale and a colour pair, and neither was selected.",
        hint="Select two cameras (cameras, --cameras).",
    ),
    FindingKind(
        "baseline.long",
        REASON,
        "The baseline is longer than 20 m",
        cause="The translation is in millimetres.",
        hint="Divide E[:3, 3], or the baseline, by 1000. If it really is in metres, set the depth range of "
        "the scene to confirm it (depth_range, --near, --far).",
    ),
    FindingKind(
        "estimate.second-motion",
        WARNING,
        "Some matches follow a second motion",
        cause="An object moved between the images, or the scene has a repetitive pattern.",
        hint="Capture both images simultaneously, or capture a static scene.",
    ),
    FindingKind(
        "estimate.learned",
        ASSUMPTION,
        "The poses were estimated from matches of a learned feature matcher",
        cause="No pose could be estimated from SIFT features: the images are dark or blurred, or have little "
        "or repetitive texture.",
        hint="Check the result, for example with a known length. Take brighter, sharper images.",
    ),
    FindingKind(
        "estimate.parallax",
        WARNING,
        "The parallax is small",
        cause="The camera hardly moved sideways.",
        hint="Move sideways by 1/20 to 1/5 of the distance to the object you measure.",
    ),
    FindingKind(
        "estimate.plane",
        WARNING,
        "Nearly all matches lie on one plane",
        cause="The images show a wall, a floor or a poster.",
        hint="Include objects at different depths, or provide the pose.",
    ),
    FindingKind(
        "estimate.unconstrained",
        WARNING,
        "The matches do not constrain the estimated pose",
        cause="The images have little texture or a short baseline.",
        hint="Take new images with more texture or a longer baseline, or provide the pose.",
    ),
    FindingKind(
        "scale.none",
        WARNING,
        "The scale is unknown",
        cause="Two images without a measured length have no metric scale.",
        hint="Provide the baseline, a known length, or known points.",
    ),
    FindingKind(
        "scale.guessed",
        ASSUMPTION,
        "The distance between the cameras is a guess",
        cause="A rough distance was chosen in the web app.",
        hint="Measure the distance, or provide a known length.",
    ),
    FindingKind(
        "scale.from-prior",
        ASSUMPTION,
        "The scale comes from the metric prior",
        cause="No length was specified, and the prior predicts metres.",
        hint="Provide a measured length to make the scale independent of the prior.",
    ),
    FindingKind(
        "points.far",
        REASON,
        "The known depths look like millimetres",
        cause="All of them are very large, or are large integers.",
        hint="Divide them by 1000, or set their scale (scale=1000, --points-scale 1000).",
    ),
    FindingKind(
        "prior.one-member",
        WARNING,
        "Only one ensemble member is computed",
        cause="The prior is deterministic.",
        hint="Leave ensemble_size (--ensemble) at 1 with this prior.",
    ),
    FindingKind(
        "capture.skipped",
        WARNING,
        "Some frames are skipped",
        cause="A frame has no image file, no pose, or an unsupported camera; the message states which.",
        hint="Ignore this warning if enough frames remain.",
    ),
    FindingKind(
        "capture.part",
        WARNING,
        "Only part of the folder is read",
        cause="The folder has several models, splits or cameras, and one of them is used.",
        hint="To use a different one, pass its file or folder.",
    ),
    FindingKind(
        "capture.images-found",
        WARNING,
        "Images were found in a different folder from the one in the camera file",
        cause="The usual folders do not hold the images, but a nearby folder has files with the same names.",
        hint="Check that they are the correct images; if not, pass the correct folder (--images).",
    ),
    FindingKind(
        "capture.masks",
        WARNING,
        "Masks found in the capture are used",
        cause="The camera file lists masks (mask_path), or a folder named masks is next to the images, as in "
        "COLMAP.",
        hint="If the masks serve another purpose, such as segmenting an object, move the folder, or pass an "
        "all-white mask (--mask) to ignore them.",
    ),
    FindingKind(
        "image.overlays",
        WARNING,
        "Part of the image is the same in at least 40 % of the frames",
        cause="Text or a logo is burnt into the frames, or part of the rig is visible.",
        hint="These pixels get no depth. If they show the scene, pass an all-white mask (--mask) to keep "
        "them.",
    ),
    FindingKind(
        "capture.no-mask",
        WARNING,
        "Masks listed in the camera file are missing",
        cause="The file has a mask_path for frames whose mask does not exist.",
        hint="Restore the masks, or pass their folder (--mask).",
    ),
    FindingKind(
        "capture.unused-poses",
        WARNING,
        "Images are read without poses, although poses may exist",
        cause="The folder also has another program's camera file, or a folder that looks like a capture.",
        hint="Pass the file or folder that the message names, or convert it as the message describes.",
    ),
    FindingKind(
        "capture.no-poses",
        WARNING,
        "The camera file has no poses",
        cause="It was written before the images were aligned.",
        hint="The poses are estimated. To use the poses of the program that wrote the file, "
        "export them after alignment.",
    ),
    FindingKind(
        "capture.size-mismatch",
        REASON,
        "The image sizes differ slightly from the calibrated sizes",
        cause="The images have not been undistorted, or come from a different export.",
        hint="Pass the folder of the matching images (--images), or the reconstruction that these images "
        "belong to.",
    ),
    FindingKind(
        "capture.assumed-metres",
        WARNING,
        "The unit of a transforms.json is assumed to be metres",
        cause="The file states no unit. It also has no sensor depth maps, which would imply metres.",
        hint="If the poses were estimated from images, or the scene was rendered in a different unit, "
        "specify a length (--known-length, --distance, --metres-per-unit).",
    ),
    FindingKind(
        "capture.gps-scale",
        WARNING,
        "The scale of the capture comes from GPS",
        cause="OpenSfM aligned the reconstruction with GPS positions, which are accurate to a few metres.",
        hint="Pass --metres-per-unit 1 to accept this scale, or specify a measured length.",
    ),
    FindingKind(
        "capture.stored-pixels",
        WARNING,
        "The EXIF orientation of the frames is not applied",
        cause="The cameras of the capture refer to the pixels as stored in the image files.",
        hint="No action is needed. The depth maps have the same orientation as the stored images.",
    ),
    FindingKind(
        "capture.assumed-k",
        WARNING,
        "K is the published value for the dataset",
        cause="The folder has no calibration file, as is usual for 7-Scenes and TUM RGB-D.",
        hint="Pass K (--K) if a different camera was used.",
    ),
    FindingKind(
        "capture.no-trajectory",
        WARNING,
        "The poses of the video are estimated without scale",
        cause="No trajectory was provided.",
        hint="Pass a trajectory (--trajectory), or specify a length (--known-length, --distance).",
    ),
    FindingKind(
        "capture.trajectory-times",
        WARNING,
        "Many frames have no pose with a matching timestamp",
        cause="The trajectory and the video start at different times, or their timestamps do not match.",
        hint="Shift the trajectory's timestamps so that the first video frame is at 0. Phones record at a "
        "variable rate, so take frame times from the container, not from frame number / frame rate.",
    ),
    FindingKind(
        "capture.blurred",
        WARNING,
        "Some frames are blurred or textureless",
        cause="Few features were found in these frames.",
        hint="Ignore this warning: no other frame depends on them. Move the camera more slowly next time.",
    ),
    FindingKind(
        "capture.no-matches",
        WARNING,
        "No two frames match",
        cause="The frames show different scenes, or are not sharp.",
        hint="Record the scene again, with more overlap.",
    ),
    FindingKind(
        "capture.convention",
        WARNING,
        "The poses are read in a different convention from the declared one",
        cause="The matches contradict the declared convention.",
        hint="Check that the convention in the message is the correct one.",
    ),
    FindingKind(
        "capture.unknown-convention",
        REASON,
        "The pose convention is unknown",
        cause="The matches fit no known convention; even the best one leaves large epipolar errors.",
        hint="Provide camera-to-world poses of these images, in OpenCV or OpenGL axes.",
    ),
    FindingKind(
        "capture.rotated",
        REASON,
        "The images are rotated relative to their cameras",
        cause="The images were rotated after capture, or their stored orientation is not the one that the "
        "poses and K assume.",
        hint="Rotate the images as the message describes, or provide poses and K for the images as stored.",
    ),
    FindingKind(
        "capture.focal",
        WARNING,
        "The best-fitting focal length is far from the given one",
        cause="K is for a different image size, or the camera motion does not constrain the focal length.",
        hint="Check K; the given focal length is used.",
    ),
    FindingKind(
        "capture.kept",
        WARNING,
        "The given poses are kept",
        cause="They fit the matches as well as the refined ones.",
        hint="No action is needed.",
    ),
    FindingKind(
        "capture.scales",
        WARNING,
        "Camera positions and depth maps imply different scales",
        cause="The tracked camera positions are inaccurate.",
        hint="Specify a known length (--known-length).",
    ),
    FindingKind(
        "capture.scale",
        REASON,
        "The scale of the capture is uncertain",
        cause="The scale varies between frames, or the trajectory contradicts the depth of the scene.",
        hint="Specify a known length (--known-length) or a distance (--distance).",
    ),
    FindingKind(
        "capture.length",
        REASON,
        "The known length cannot be measured accurately in its frame",
        cause="An endpoint of --known-length has uncertain depth: it is textureless, on a depth edge, or "
        "seen by no other frame.",
        hint="Choose different endpoints, or specify a distance (--distance).",
    ),
    FindingKind(
        "capture.wrong-poses",
        WARNING,
        "The given poses of some frames are wrong",
        cause="The tracker jumped.",
        hint="No action is needed: the estimated poses are used.",
    ),
    FindingKind(
        "capture.unconnected",
        WARNING,
        "Some frames are not connected to the others",
        cause="They share too few points with other frames, or refinement made their fit worse.",
        hint="Ignore this warning if enough frames remain; otherwise record with more overlap.",
    ),
    FindingKind(
        "capture.components",
        WARNING,
        "The capture has several disconnected components",
        cause="No frames connect them.",
        hint="Record frames that connect the components, or process each one separately.",
    ),
    FindingKind(
        "capture.no-video",
        WARNING,
        "The video was not written",
        cause="This OpenCV build has no codec for it.",
        hint="All other files are written. Install an OpenCV build with video codecs to get the video.",
    ),
    FindingKind(
        "depth.reprojected-empty",
        WARNING,
        "The camera of --reproject sees no depth",
        cause="It looks in another direction, or is too far away.",
        hint="Check that its E is its pose in the left camera's frame (camera-to-world), in metres.",
    ),
    FindingKind(
        "pairs.in-order",
        WARNING,
        "The images of two folders are paired by position, not by name",
        cause="The folders have no file name in common.",
        hint="Check the first and last pair in the message. If they are wrong, rename the images so that "
        "both images of a pair have the same name.",
    ),
    FindingKind(
        "pairs.side-by-side",
        WARNING,
        "One image or video holds both views",
        cause="--side-by-side was passed without a layout, or only one video was passed.",
        hint="Specify the layout if the inferred one is wrong, or pass both videos if this one contains only "
        "the left view.",
    ),
    FindingKind(
        "pairs.layout",
        ASSUMPTION,
        "The layout of an image or video that holds both views is assumed",
        cause="No layout was specified, and the image's shape and content are inconclusive.",
        hint="Specify it (--side-by-side full, half, over-under or half-over-under). A wrong layout can make "
        "all depths wrong by a factor of 2.",
    ),
    FindingKind(
        "pairs.offset",
        ASSUMPTION,
        "The time between the starts of two videos is estimated",
        cause="The videos have different lengths, or their brightness changes at different times.",
        hint="Specify the start time of RIGHT relative to LEFT, in seconds (--offset; positive if RIGHT "
        "started later), or trim both videos to the same time span.",
    ),
    FindingKind(
        "config.unknown-parameters",
        WARNING,
        "Unknown parameters are ignored",
        cause="The configuration was saved by an earlier version.",
        hint="Save the configuration again.",
    ),
)
FINDINGS = {kind.code: kind for kind in _KINDS}
