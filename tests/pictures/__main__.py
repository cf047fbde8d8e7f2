"""Pictures of README and the documentation; what computes is imported by those that need it.

python -m tests.pictures rooms --data FOLDER
python -m tests.pictures mistaken
python -m tests.pictures charts
python -m tests.pictures notebook
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from geodiff_plugin.cli.commands import APPEARANCE
from tests.pictures.badges import write_badges
from tests.pictures.charts import write_charts
from tests.pictures.notebook import write_notebook

IMAGES = Path("docs/images")
#: The room of the moving picture, those of README's tiles, and that of prior beside guided depth.
MOVING = "toy"
TILES = ("cycles", "toy", "desk")
SLIDER = "toy"
#: Rooms with plain walls.
WALLS = ("bedroom_chair", "corridor", "cycles", "desk")

app = typer.Typer(help="Make pictures of README and the documentation.", **APPEARANCE)
Images = Annotated[Path, typer.Option(help="Folder for the pictures.")]


@app.command()
def rooms(
    data: Annotated[
        Path, typer.Option(help="Folder of NAME_left.png, NAME_right.png and their calibration.")
    ],
    images: Images = IMAGES,
) -> None:
    """The moving picture, tiles, the gallery, the slider and walls: real rooms, and rendered scenes."""
    from tests.pictures.gallery import write_rendered, write_room, write_slider, write_tiles, write_walls
    from tests.pictures.moving import write_moving
    from tests.pictures.rooms import ROOMS, room_named, solve

    results = {room.name: solve(data, room) for room in ROOMS}
    write_moving(results[MOVING], room_named(MOVING), images / "moving.webp")
    write_tiles([(room_named(name), results[name]) for name in TILES], images / "rooms.webp")
    write_slider(results[SLIDER], images)
    for room in ROOMS:
        write_room(room, results[room.name], images / "gallery" / f"{room.name}.webp")
    write_rendered(images / "gallery")
    write_walls(data, WALLS, images / "walls.webp")


@app.command()
def mistaken(
    page: Annotated[Path, typer.Option(help="The page that is written.")] = Path(
        "docs/explanation/mistaken.md"
    ),
    images: Images = IMAGES,
) -> None:
    """The page about one pair that is given with usual mistakes, and its picture."""
    from tests.pictures.mistaken import write_mistaken

    write_mistaken(page, images, "python -m tests.pictures mistaken")


@app.command()
def charts(
    pages: Annotated[Path, typer.Option(help="Folder of the pages with tables.")] = Path("docs/reference"),
    images: Images = IMAGES,
) -> None:
    """A bar chart above every table of results, made from the table."""
    write_charts(pages, images)


@app.command()
def notebook(
    path: Annotated[Path, typer.Option(help="The notebook.")] = Path("examples/quickstart.ipynb"),
) -> None:
    """The outputs of the notebook, which is run as it stands."""
    write_notebook(path)


@app.command()
def badges(images: Images = IMAGES) -> None:
    """The badges of README."""
    write_badges(images)


if __name__ == "__main__":
    app(prog_name="python -m tests.pictures")
