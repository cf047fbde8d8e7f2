"""Regenerate the images of the README and the documentation.

python -m tests.images rooms --data FOLDER
python -m tests.images mistaken
python -m tests.images notebook
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path

from geodiff_plugin.cli.commands import new_group
from geodiff_plugin.options import Command
from geodiff_plugin.settings import setting
from tests.images.badges import write_badges
from tests.images.notebook import write_notebook

IMAGES = Path("docs/images")
#: Rooms of the animation, of the tiles, and of the comparison of prior and guided depth.
MOVING = "toy"
TILES = ("cycles", "toy", "desk")
SLIDER = "toy"
#: Rooms with plain walls.
WALLS = ("bedroom_chair", "corridor", "cycles", "desk")


@dataclass(frozen=True, kw_only=True)
class _Images:
    images: Path = setting(IMAGES, "Folder for the images.")


@dataclass(frozen=True, kw_only=True)
class _Rooms(_Images):
    data: Path = setting(MISSING, "Folder of NAME_left.png, NAME_right.png and their calibration.")


@dataclass(frozen=True, kw_only=True)
class _Mistaken(_Images):
    page: Path = setting(Path("docs/how-to/debugging-a-pair.md"), "Page with the table.")


@dataclass(frozen=True, kw_only=True)
class _Notebook:
    path: Path = setting(Path("examples/quickstart.ipynb"), "Notebook.")


def _rooms(options: _Rooms) -> None:
    from tests.images.gallery import write_rendered, write_room, write_slider, write_tiles, write_walls
    from tests.images.moving import write_moving
    from tests.images.rooms import ROOMS, room_named, solve

    data, images = options.data, options.images
    results = {room.name: solve(data, room) for room in ROOMS}
    write_moving(results[MOVING], room_named(MOVING), images / "moving.webp")
    write_tiles([(room_named(name), results[name]) for name in TILES], images / "rooms.webp")
    write_slider(results[SLIDER], images)
    for room in ROOMS:
        write_room(room, results[room.name], images / "gallery" / f"{room.name}.webp")
    write_rendered(images / "gallery")
    write_walls(data, WALLS, images / "walls.webp")


def _mistaken(options: _Mistaken) -> None:
    from tests.images.mistaken import write_mistaken

    write_mistaken(options.page, options.images)


COMMANDS = {
    "rooms": Command(
        _Rooms,
        _rooms,
        "Animation, tiles, gallery, comparison and walls: real rooms and rendered scenes.",
    ),
    "mistaken": Command(_Mistaken, _mistaken, "Table and image of the demo pair with common input errors."),
    "notebook": Command(
        _Notebook,
        lambda options: write_notebook(options.path),
        "Outputs of the notebook, which is run unchanged.",
    ),
    "badges": Command(_Images, lambda options: write_badges(options.images), "Badges of the README."),
}
app = new_group("Regenerate the images of the README and the documentation.", COMMANDS)

if __name__ == "__main__":
    app.main(prog_name="python -m tests.images")
