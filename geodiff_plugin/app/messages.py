"""The page's own sentences for findings and input errors, by their code.

Each sentence states what was found, and what to do on the page. The command's message, with its numbers, is a
detail below it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from geodiff_plugin._internal.checks import InputError, UnknownFormatError
from geodiff_plugin.findings import Finding

#: Prefixes of the codes of findings that the page cannot cause: it takes two images and no points.
NOT_ON_THE_PAGE = ("capture.", "pairs.", "points.", "config.", "depth.reprojected-empty")


class PageError(InputError):
    """An input error whose text is a sentence of the page."""


@dataclass(frozen=True)
class Message:
    """A sentence of the page, and what to do; ``detail`` is the command's message."""

    text: str
    hint: str = ""
    detail: str = ""


_SWAP = "Swap the left and the right image, then run again."
_CALIBRATION = "Check that the calibration belongs to these two images."
_BASELINE = 'Use a file for both cameras, or choose "Focal length and baseline" and enter both.'
_RETAKE = "Take two new images of a scene in which nothing moves."
_LENGTH = "Check the distance between the cameras and its unit: the page expects metres."
_WIDER = "Take the second image from a position further to the side."
_CROP = "Use the original images, not cropped or resized."
_NOTHING = "No action is needed."

#: Code of a finding -> sentence and what to do.
FINDINGS_ON_PAGE: dict[str, tuple[str, str]] = {
    "image.frames": ("An image file has several pages. The first one is used.", _NOTHING),
    "image.dark": ("A 16-bit image is nearly black.", "Export it at full brightness, or as an 8-bit image."),
    "image.bits": ("A 16-bit image is treated as a 10-, 12- or 14-bit image.", _NOTHING),
    "image.alpha": (
        "Transparent pixels get no depth.",
        "Remove the transparency if these pixels contain scene content.",
    ),
    "image.rotated": (
        "An image was rotated upright, according to the orientation tag in its file.",
        "Make sure that the calibration is for the upright image.",
    ),
    "image.orientation": (
        "An image file has an orientation tag, which is not applied.",
        "Save the image upright.",
    ),
    "image.overlays": (
        "Part of the image, such as text or a logo, does not belong to the scene.",
        "Use images without it, if it covers what you measure.",
    ),
    "camera.from-exif": (
        "The focal length comes from the image files. It may be off by a few percent.",
        "For exact lengths, use a calibrated camera.",
    ),
    "camera.from-list": (
        "The focal length is the manufacturer's value for the camera that you selected. It may be off by a "
        "few percent, or more if the image was taken with digital zoom or cropped.",
        "Check the camera and the lens in the form.",
    ),
    "camera.from-fov": (
        "The field of view that you entered is assumed to be correct.",
        "Check it in the form. It is the angle across the width of the image.",
    ),
    "camera.assumed-intrinsics": (
        "The optical centre is assumed to be at the centre of the image.",
        'Enter fy, cx and cy with "Focal length and baseline" if you know them.',
    ),
    "camera.zoom": (
        "An image was taken with digital zoom.",
        "Take it again without digital zoom, or enter fx.",
    ),
    "camera.assumed-cx": (
        "The right camera's cx is assumed to be the left camera's.",
        'Enter its cx with "Focal length and baseline" if you know it.',
    ),
    "camera.principal-point": (
        "The optical centre in the calibration is far from the centre of the image, as if the image were "
        "cropped or resized.",
        f"{_CROP} {_CALIBRATION}",
    ),
    "camera.aspect-ratio": (
        "The focal lengths fx and fy differ by more than a factor of two.",
        "Check both numbers.",
    ),
    "camera.focal-mismatch": (
        "The focal length contradicts the one in the image file.",
        f"{_CALIBRATION} If you typed fx, check that it is for this image size.",
    ),
    "camera.swapped": (
        "The calibrations of the left and right camera seem to be swapped.",
        "Swap them in the file, or swap the images.",
    ),
    "camera.scaled": ("The calibration seems to be for a different image size.", _CROP),
    "camera.focal-scaled": ("The focal length seems to be for a different image size.", _CROP),
    "camera.cx-mismatch": (
        "Either the two cameras have different cx values, or the images do not belong together.",
        "Enter the right camera's cx, or use a calibration file for both cameras.",
    ),
    "camera.field-of-view": (
        "The lens has an unusual field of view.",
        "Check the focal length if the lens is neither a telephoto nor a fisheye lens.",
    ),
    "camera.unconfirmed-field-of-view": (
        "This focal length implies an unusual field of view.",
        "Check that fx is in pixels, for images of this size.",
    ),
    "calibration.no-unit": (
        "The calibration has no unit of length.",
        "Enter the distance between the cameras.",
    ),
    "calibration.assumed-metres": (
        "The calibration states no unit. If it is in metres, the cameras are unusually far apart.",
        "Enter the measured distance between the cameras.",
    ),
    "calibration.unrectified": ("The images are treated as not rectified.", _CALIBRATION),
    "calibration.doffs": (
        "The right camera's cx is computed from doffs: it is missing in the calibration, or contradicts "
        "doffs.",
        _CALIBRATION,
    ),
    "calibration.assumed-lens": ("The focal length is the usual one for this dataset.", _CALIBRATION),
    "calibration.kitti-cameras": ("KITTI's colour cameras are used.", "Use images of the colour cameras."),
    "baseline.long": ("With this baseline, the cameras are more than 20 m apart.", _LENGTH),
    "baseline.short": ("With this baseline, the cameras are less than a millimetre apart.", _LENGTH),
    "pose.unit": ("The distances between the cameras and to the scene are implausibly large.", _LENGTH),
    "pose.opengl": ("The camera positions in the file seem to use OpenGL axes.", _CALIBRATION),
    "pose.opengl-inverse": ("The camera positions in the file seem to be inverted.", _CALIBRATION),
    "pose.transposed": ("The rotation in the file seems to be transposed.", _CALIBRATION),
    "pose.mixed": ("The camera positions in the file mix two conventions.", _CALIBRATION),
    "pose.vertical": (
        "One camera seems to be above the other, not next to it.",
        "Use a calibration file with the vertical offset, or estimate the camera positions from the images.",
    ),
    "pose.unconstrained": ("The images do not determine how the cameras were placed.", _WIDER),
    "pose.unchecked": (
        "The calibration could not be checked: there are too few matching points.",
        _CALIBRATION,
    ),
    "pose.few-matches": ("There are too few matching points to correct the calibration.", _CALIBRATION),
    "pose.kept": ("The images deviate from the calibration by more than a pixel.", _CALIBRATION),
    "pose.refined": ("The calibration was corrected slightly to fit the images.", _NOTHING),
    "pose.too-far": (
        "The images fit different camera positions from the ones in the calibration.",
        _CALIBRATION,
    ),
    "pose.epipolar-error": (
        "The images do not fit the calibration.",
        f"{_CALIBRATION} Or estimate the camera positions from the images.",
    ),
    "pose.residual": ("The images fit the calibration only roughly.", _CALIBRATION),
    "estimate.second-motion": ("Part of the scene moved, or a pattern repeats.", _RETAKE),
    "estimate.parallax": ("The camera hardly moved sideways, so depth is inaccurate.", _WIDER),
    "estimate.plane": (
        "Nearly everything is on one plane, so the camera positions are uncertain.",
        "Take images with objects at different distances.",
    ),
    "estimate.unconstrained": ("The images do not determine the camera positions well.", _WIDER),
    "estimate.learned": (
        "The images are dark, blurred or plain, so the camera positions come from a learned matcher.",
        "Check a distance that you know, or take brighter, sharper images.",
    ),
    "scale.none": ("No length is known.", "Enter the distance between the cameras, or a known length."),
    "scale.from-prior": ("The scale is the prior's guess.", "Enter a measured length."),
    "scale.guessed": (
        "The distance between the cameras is a guess. Every length has the same relative error as this "
        "guess.",
        "Measure it, or mark an object whose length you know.",
    ),
    "scale.uncertain": ("The scale is uncertain.", "Enter the measured distance between the cameras."),
    "views.identical": ("Both images are the same file.", "Choose a second image from a different position."),
    "views.shifted": (
        "Everything seems to be at one distance, as if one image were a shifted copy.",
        "Use two images from different positions, with objects at different distances.",
    ),
    "views.moved": ("Part of the scene moved between the images.", _RETAKE),
    "views.tearing": ("An image is torn: it combines parts of two video frames.", "Take that image again."),
    "views.rolling-shutter": (
        "Vertical lines lean in the right image: the camera or the scene moved during the exposure.",
        "Take it again with the camera held still.",
    ),
    "views.distorted": ("Straight lines are bent by the lens.", _CALIBRATION),
    "views.residual-trend": (
        "The images fit the calibration well in some regions and badly in others.",
        _CALIBRATION,
    ),
    "views.overlap": (
        "The images show mostly different parts of the scene.",
        "Take them so that at least half of one is visible in the other.",
    ),
    "views.inconsistent": (
        "The images do not fit together.",
        f"Check that both show the same scene. {_CALIBRATION}",
    ),
    "views.blocked": ("Part of one image is blank.", "Uncover the lens, and take that image again."),
    "views.repeated-pattern": (
        "Part of the image is a repeated pattern, such as a fence or tiles.",
        "Do not measure on it where the confidence is low.",
    ),
    "depth.repeated-pattern": (
        "A repeated pattern fits several depths, so its depth is ambiguous.",
        "Take images that show more than the pattern, or move the cameras closer together.",
    ),
    "views.letterbox": (
        "The images have black borders.",
        "Crop them, unless the calibration is for images with these borders.",
    ),
    "views.defocused": ("One image is much blurrier than the other.", "Take that image again."),
    "depth.inverted-order": (
        "Near and far are swapped. The left and right images are probably swapped.",
        _SWAP,
    ),
    "depth.range": (
        "The scene extends beyond the depths that you entered.",
        "Clear the fields 'Nearest depth' and 'Farthest depth'.",
    ),
    "depth.off-matches": (
        "The depth does not fit the matched points.",
        "Choose a different prior, or take images with more overlap and texture.",
    ),
    "depth.order-points": ("The prior contradicts the known depths.", "Choose a different prior."),
    "depth.occlusion": ("Far objects hide near ones. The left and right images are probably swapped.", _SWAP),
    "depth.order": (
        "The prior and the matches disagree about which objects are near.",
        f"{_SWAP} {_CALIBRATION}",
    ),
    "depth.negative-disparity": (
        "Some points match in the wrong direction.",
        f"{_CALIBRATION} Or enter the right camera's cx.",
    ),
    "depth.search-edge": ("The scale may be outside of the range that was searched.", _LENGTH),
    "prior.one-member": ("This prior always gives the same result, so it runs only once.", _NOTHING),
    "prior.unit": ("The depth differs from what the prior expects by more than a factor of 20.", _LENGTH),
    "prior.metres": ("The depth differs from what the prior expects.", _LENGTH),
    "prior.order": (
        "According to the matches, the prior swaps near and far.",
        "Do not measure where the confidence is low.",
    ),
    "verdict.not-trusted": ("Do not trust this depth.", "See the reasons."),
    "verdict.not-judged": ("This depth could not be verified.", "Use images with more overlap and texture."),
}

#: Code of an input error -> sentence and what to do.
ERRORS_ON_PAGE: dict[str, tuple[str, str]] = {
    "image.unreadable": ("An image file cannot be read.", "Save it as JPEG or PNG, and drop it again."),
    "image.small": ("An image is too small.", "Use the original image, not its preview."),
    "image.heic": ("This server cannot read HEIC files.", "Save the image as JPEG or PNG."),
    "exif.missing": (
        "The image files do not state the focal length.",
        "Choose your camera in the list, or enter its field of view.",
    ),
    "exif.cropped": (
        "An image was cropped, so the focal length in its file is not valid.",
        "Use the original image, or choose your camera in the list if it was only resized.",
    ),
    "file.empty": ("A file is empty.", "Export or download it again."),
    "calibration.size": ("The calibration is for images of a different size.", _CROP),
    "calibration.one-camera": (
        "The calibration file describes one camera.",
        "Add the file for the other camera, or estimate the camera positions from the images.",
    ),
    "calibration.no-baseline": (
        "The calibration file does not state the distance between the cameras.",
        _BASELINE,
    ),
    "camera.principal-point": ("The optical centre in the calibration is outside the image.", _CROP),
    "camera.focal-unit": ("The focal length is not in pixels.", "Enter fx in pixels of this image."),
    "baseline.sign": ("The distance between the cameras must be positive.", _SWAP),
    "estimate.few-matches": (
        "The two images have too little in common.",
        "Take two sharp, well-lit images of the same scene, with at least half of one visible in the other.",
    ),
    "estimate.no-motion": (
        "The two images do not show one scene from two positions.",
        f"{_RETAKE} Do not mirror or edit them.",
    ),
    "estimate.two-motions": ("Something moved between the images.", _RETAKE),
    "estimate.rotation": (
        "The camera was rotated but not moved, so the images contain no depth.",
        "Step to the side for the second image.",
    ),
    "known-length.ends": (
        "The known length ends on a surface without recognisable points.",
        "Choose ends on textured surfaces that both images show.",
    ),
    "known-length.one-point": ("Both ends of the known length are the same point.", "Tap its ends again."),
    "memory": ("The images do not fit in the memory of this server.", "Downscale both images."),
}
_UNKNOWN_FORMAT = ("The calibration file is in an unsupported format.", "")
_OTHER = "The images and the camera parameters cannot be used together."
#: Source of the cameras -> what to do if an error has no code.
_OTHER_HINTS = {
    "file": _CALIBRATION,
    "numbers": "Check fx, fy, cx, cy and the distance between the cameras.",
    "images": "Check the images, the focal length and the length that you entered.",
}


def check_inside(pixel: tuple[int, int], size: tuple[int, int], name: str) -> None:
    """Raise ``PageError`` if a pixel ``(x, y)`` is outside of an image ``(width, height)``."""
    (x, y), (width, height) = pixel, size
    if not (0 <= x < width and 0 <= y < height):
        raise PageError(
            f"{name} is outside of the image: x goes from 0 to {width - 1}, y from 0 to {height - 1}."
        )


def on_page(finding: Finding, folders: Iterable[Path] = ()) -> Message:
    """Return the page's sentence for a finding, with the command's message as detail."""
    text, hint = FINDINGS_ON_PAGE.get(finding.code, (f"{finding.kind.title}.", ""))
    return Message(text, hint, without_folders(str(finding), folders))


def error_on_page(error: InputError, folders: Iterable[Path] = (), camera_input: str = "") -> Message:
    """Return the page's sentence for an input error, with the command's message as detail.

    ``camera_input`` is the source of the cameras, a key of ``job.CAMERA_INPUTS``, if it is known.
    """
    if isinstance(error, PageError):
        return Message(str(error))
    if isinstance(error, UnknownFormatError):
        return Message(*_UNKNOWN_FORMAT)
    text, hint = ERRORS_ON_PAGE.get(error.code, (_OTHER, _OTHER_HINTS.get(camera_input, "")))
    return Message(text, hint, without_folders(str(error), folders))


def without_folders(text: str, folders: Iterable[Path]) -> str:
    """Remove the server's folders, which contain the visitor's files, from a message."""
    for folder in folders:
        text = text.replace(f"{folder}/", "").replace(str(folder), "")
    return text
