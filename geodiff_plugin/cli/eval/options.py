"""Options that the commands of ``geodiff eval`` share, with their help.

Data flow: argv -> ``PairsOptions``.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Callable
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geodiff_plugin.formats.out import check_out

if TYPE_CHECKING:
    from geodiff_plugin.evaluation.options import PairsOptions
    from geodiff_plugin.evaluation.report import Page

__all__ = ["SAMPLES", "SETTINGS", "names", "pairs_options", "run_and_print", "takes"]


def _checked(out: Path) -> Path:
    """A folder that can be one, or the error before torch is imported."""
    check_out(out)
    return out


Data = Annotated[Path | None, typer.Option("--data", help="Folder with data sets, or synthetic:N.")]
Methods = Annotated[
    str | None, typer.Option(help="Comma-separated, see geodiff eval list; run beside the built-in rows.")
]
Datasets = Annotated[str | None, typer.Option(help="Comma-separated; all that the folder has by default.")]
Scenes = Annotated[str | None, typer.Option(help="Comma-separated parts of sample names to keep.")]
Limit = Annotated[
    int | None, typer.Option(help="The first N samples alone; in a table of the paper, of each set.")
]
Sample = Annotated[int | None, typer.Option(help="Draw this many samples at random, by --seed.")]
ViewPairs = Annotated[
    str, typer.Option("--pairs", help="Of a group of posed views: default (the first two) or all.")
]
PixelCentre = Annotated[
    float | None,
    typer.Option(help="First pixel's centre in posed cameras, 0.5 for COLMAP's; each set's own by default."),
]
Crop = Annotated[str, typer.Option(help="Region that is scored: none, garg, eigen or benchmark (KITTI).")]
Prior = Annotated[str, typer.Option(help="'bundled', a hub id or a folder.")]
Priors = Annotated[
    list[str] | None,
    typer.Option("--prior", help="'bundled' (the default), a hub id or a folder; repeat it for more rows."),
]
Space = Annotated[
    str | None, typer.Option(help="Space in which the prior's map is affine, if its folder does not say.")
]
Ensemble = Annotated[int, typer.Option(help="Ensemble members.")]
Seed = Annotated[int, typer.Option(help="Seed of the noise.")]
Seeds = Annotated[
    int, typer.Option(help="Seeds, from --seed on, of methods that use a prior; a table has their spread.")
]
Steps = Annotated[int | None, typer.Option(help="Denoising steps; each method's own by default.")]
Resolution = Annotated[int | None, typer.Option(help="Longer side for the prior, pixels.")]
Pose = Annotated[
    str | None,
    typer.Option(help="Rows of 'guided': refine, given or estimated (poses withheld), comma-separated."),
]
Perturb = Annotated[
    str | None,
    typer.Option(metavar="DEGREES,SHARE", help="Give poses wrongly: largest turn, and shift / baseline."),
]
Views = Annotated[int, typer.Option(help="Views that methods take of a group that has more than two.")]
Device = Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:N or mps.")]
Dtype = Annotated[str, typer.Option(help="float32, bfloat16 or float16.")]
Out = Annotated[
    Path,
    typer.Option("--out", "-o", callback=_checked, help="Records and results; resumed where it exists."),
]
SkipBroken = Annotated[bool, typer.Option("--skip-broken", help="Go on after a broken sample and count it.")]
SaveDepth = Annotated[bool, typer.Option("--save-depth", help="Write every depth map as .npy.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No bar and nothing on the screen.")]
Results = Annotated[Path | None, typer.Option(help="Write the Markdown page here as well.")]

#: Every option that more than one command has: its type and help, and its default.
_SHARED: dict[str, tuple[Any, Any]] = {
    "methods": (Methods, None),
    "datasets": (Datasets, None),
    "scenes": (Scenes, None),
    "limit": (Limit, None),
    "sample": (Sample, None),
    "pairs": (ViewPairs, "default"),
    "pixel_centre": (PixelCentre, None),
    "crop": (Crop, "none"),
    "prior": (Priors, None),
    "space": (Space, None),
    "ensemble": (Ensemble, 1),
    "seed": (Seed, 0),
    "seeds": (Seeds, 1),
    "steps": (Steps, None),
    "resolution": (Resolution, None),
    "views": (Views, 2),
    "pose": (Pose, None),
    "perturb": (Perturb, None),
    "device": (Device, "auto"),
    "dtype": (Dtype, "float32"),
    "out": (Out, Path("geodiff-eval")),
    "results": (Results, None),
    "skip_broken": (SkipBroken, False),
    "save_depth": (SaveDepth, False),
    "quiet": (Quiet, False),
}
#: Those that choose samples, and those of ``Settings`` that every command with a prior has.
SAMPLES = ("datasets", "scenes", "limit")
SETTINGS = ("space", "ensemble", "seed", "steps", "resolution", "views", "device", "dtype")


def names(text: str | None) -> tuple[str, ...]:
    """Parts of a comma-separated list, empty for ``None``."""
    return tuple(part.strip() for part in (text or "").split(",") if part.strip())


def takes(*shared: str, **defaults: Any) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command options of ``_SHARED`` behind its own; they arrive as its keywords.

    Args:
        *shared: their names, in the order of the help.
        **defaults: values by default that are other than in the table; ``prior="bundled"`` takes one alone.
    """

    def parameter(name: str) -> Parameter:
        kind, default = _SHARED[name]
        if name == "prior" and name in defaults:
            kind = Prior
        return Parameter(name, Parameter.KEYWORD_ONLY, annotation=kind, default=defaults.get(name, default))

    def with_options(command: Callable[..., None]) -> Callable[..., None]:
        own = [
            one
            for one in signature(command, eval_str=True).parameters.values()
            if one.kind is not Parameter.VAR_KEYWORD
        ]
        # Typer asks for the signature; this is where one that is put together is looked for.
        vars(command)["__signature__"] = Signature([*own, *map(parameter, shared)])
        return command

    return with_options


def pairs_options(typed: dict[str, Any]) -> PairsOptions:
    """What was typed, as the commands take it.

    Args:
        typed: options by name; the ``Settings`` among them are put together, lists are split, and what a
            command does not offer has its neutral value.
    """
    from geodiff_plugin.evaluation.baselines import Settings
    from geodiff_plugin.evaluation.datasets.perturbed import perturbation
    from geodiff_plugin.evaluation.options import PairsOptions
    from geodiff_plugin.runtime.machine import pick_device

    neutral: dict[str, Any] = {"sample": None, "pairs": "default", "pixel_centre": None, "results": None}
    neutral |= {"skip_broken": False, "save_depth": False, "quiet": False}
    rest = {name: value for name, value in typed.items() if name not in (*SETTINGS, "prior")}
    given = typed.get("prior")
    prior, *further = [given] if isinstance(given, str) else list(dict.fromkeys(given or ["bundled"]))
    lists = {name: names(typed.get(name)) for name in ("methods", "datasets", "scenes", "pose")}
    perturb = None if typed.get("perturb") is None else perturbation(typed["perturb"])
    chosen = {name: typed[name] for name in SETTINGS if name in typed}
    settings = Settings(prior, **chosen | {"device": str(pick_device(typed["device"]))})
    found = neutral | rest | lists | {"perturb": perturb}
    return PairsOptions(**found, settings=settings, priors=tuple(further))


def run_and_print(command: Callable[[PairsOptions], Page | None], options: PairsOptions) -> None:
    """Run a command of the evaluation and print its page, in the main process and unless ``quiet``."""
    page = command(options)
    if page is not None and not options.quiet:
        from geodiff_plugin.cli.eval.printing import print_page

        print_page(page)
