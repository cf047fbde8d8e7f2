"""The run of a guided call with stand-ins for network, guided steps and result."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from geodiff_plugin.algorithm.schedule import Round
from geodiff_plugin.algorithm.step import GuidedStep
from geodiff_plugin.config import DEFAULT, UpdatePlan
from geodiff_plugin.evidence.guidance import SAME_CENTRE
from geodiff_plugin.findings import Finding
from geodiff_plugin.runtime import run as run_module
from geodiff_plugin.runtime.codec import ProcessingGrid, StepInputs
from geodiff_plugin.runtime.run import GuidedRun, _latents_of
from geodiff_plugin.trust import Call

GRID = ProcessingGrid((4, 6), (2, 1))
CHANNELS = slice(1, 3)


class Trajectory:
    """Records its samples, its calls, and the maps of which the result is requested."""

    def __init__(self, config, evidence, image_of_sample, maps, lr_latents) -> None:
        self.made_of = (config, evidence, image_of_sample, maps, lr_latents)
        self.captured_warnings, self.history, self.step = [], [], None
        self.affine = SimpleNamespace(scale=torch.tensor(2.0), shift=torch.tensor(7.0))
        self.watch = SimpleNamespace(check=lambda pipe: self.checked.append(pipe))
        self.checked = []

    def record(self, name, tensor):
        self.captured_warnings.append((self.step, name, tensor))

    def metric(self, x, affine):
        return affine.scale * x + affine.shift

    def result(self, x):
        return self.metric(x, self.affine)

    def members(self, x, depth_m):
        return [(x[i : i + 1], depth_m[i : i + 1]) for i in range(len(x))]


class Prior:
    depth_channels, network_input, max_steps = CHANNELS, slice(2, 4), None

    def __init__(self) -> None:
        self.net = nn.Conv2d(4, 5, 1)

    def network(self):
        return self.net, "forward"

    def maps_of(self, samples):
        return ("maps", samples)

    def decode(self, z0):
        return z0.mean(1, keepdim=True).double()


class Scheduler:
    def set_timesteps(self, *_, **__):
        pass

    def step(self, *_, **__):
        pass


def a_run(
    *, images=3, members=2, batch=4, callback=None, rounds=1, tiny=None, gradient="denoised", **parameters
):
    """A run, and the parts that it was made of; ``steps`` holds what each guided step is to give."""
    plan = parameters.pop("plan", UpdatePlan(0, 0.0, 0.03))
    config = DEFAULT.changed(gradient=gradient, **parameters)
    faster = SimpleNamespace(attached=lambda pipe: run_module.hooks.replaced(pipe, "was_faster", True))
    prior = Prior()
    pipe = SimpleNamespace(
        scheduler=Scheduler(), image_processor=SimpleNamespace(preprocess=lambda *_: None), _faster=faster,
        components={"unet": prior.net}, _progress_bar_config={"disable": True},
    )  # fmt: skip
    decoded = []
    codec = SimpleNamespace(
        pipe=pipe, prior=prior, grid=GRID, tiny=tiny,
        decode=lambda z0, final=False: decoded.append((z0, final)) or z0.sum(1, keepdim=True),
    )  # fmt: skip
    guidance = SimpleNamespace(
        fill=True,
        config=config, inputs=[None] * images, updates=plan, through_network=gradient == "full",
        unit="m", calibrated=False,
    )  # fmt: skip
    call = {
        "image": torch.zeros(images, 3, 4, 6), "ensemble_size": members, "batch_size": batch,
        "output_latent": False, "resample_method_output": "bicubic", "ensembling_kwargs": None,
        "output_type": "pt",
    }  # fmt: skip
    plan = SimpleNamespace(evidence="evidence", complete=lambda: "complete evidence")
    made = GuidedRun(codec, guidance, lambda: [plan] * images, call, rounds, callback)
    return SimpleNamespace(run=made, pipe=pipe, codec=codec, guidance=guidance, call=call, decoded=decoded)


@pytest.fixture
def steps(monkeypatch):
    """Stand-ins for trajectories, estimates and guided steps; notes what they are given."""
    now = SimpleNamespace(guided=[], estimates=[], levels=[], current=True, number=0)

    class Estimate:
        def __init__(self, *arguments) -> None:
            now.estimates.append(arguments)

        def step_inputs(self, offset, from_updated):
            return StepInputs("output", "z_t", (offset, from_updated))

    def guided_step(trajectory, estimate, rounds, is_last):
        now.number += 1
        now.guided.append((trajectory, trajectory.step, estimate, rounds, is_last))
        trajectory.history.append(SimpleNamespace(loss=now.number * torch.tensor([0.5, 0.1, 0.2, 1.2])))
        return GuidedStep("move", torch.full((2, 1, 4, 6), float(now.number)), now.current)

    monkeypatch.setattr(run_module, "Trajectory", Trajectory)
    monkeypatch.setattr(run_module, "StepEstimate", Estimate)
    monkeypatch.setattr(run_module, "guided_step", guided_step)
    monkeypatch.setattr(run_module, "noise_level", lambda *each: now.levels.append(each) or "level")
    return now


def latents(count: int = 2, seed: int = 0) -> torch.Tensor:
    return torch.randn(count, 5, 3, 4, generator=torch.Generator().manual_seed(seed))


def test_samples_of_all_images_are_guided_chunk_by_chunk(steps):
    """Three images of two members in chunks of four samples; of three steps the last two are guided."""
    made = a_run(plan=UpdatePlan(2, 0.5, 0.07))
    run, times = made.run, torch.tensor([900, 600, 300])
    for chunk in range(2):
        run.begin(times)
        for k, t in enumerate(times):
            output, z_t = latents(seed=10 * chunk + k), latents(seed=100 + 10 * chunk + k)
            inputs = run.guide(output, t, z_t)
            if k == 0:
                assert inputs.output is output and inputs.z_t is z_t and inputs.offset is None
                assert len(run.trajectories) == chunk
            else:
                assert inputs == ("output", "z_t", ("move", False))
                assert steps.estimates[-1][:5] == (made.codec, "level", output, z_t, None)
                assert steps.estimates[-1][5] == (k != 2)
                assert steps.levels[-1] == (made.pipe.scheduler, t)
            assert torch.equal(run.after_step(t, z_t), z_t)
    config = made.guidance.config
    for chunk, (trajectory, images) in enumerate(zip(run.trajectories, ([0, 0, 1, 1], [2, 2]), strict=True)):
        samples = slice(4 * chunk, 4 * chunk + 4)
        assert trajectory.made_of == (config, ["evidence"] * 3, images, ("maps", samples), 0.07)
        ((step, name, first),) = trajectory.captured_warnings
        assert step == (0, 900.0) and "output" in name
        assert torch.equal(first, latents(seed=10 * chunk)[:, CHANNELS])
        guided = [each[1:] for each in steps.guided if each[0] is trajectory]
        assert [(step, is_last) for step, _, _, is_last in guided] == [
            ((1, 600.0), False),
            ((2, 300.0), True),
        ]
        assert [rounds for _, _, rounds, _ in guided] == list(run.schedule.steps[1:])
    assert run.schedule.steps == ((), (Round(True, 2),), (Round(True, 2),))


def test_several_rounds_a_step_and_a_prior_whose_map_cannot_be_encoded(steps):
    made = a_run(rounds=3, match_fits=2, plan=UpdatePlan(1, 0.0, 0.1))
    made.run.begin(torch.tensor([9, 3]))
    assert [len(rounds) for rounds in made.run.schedule.steps] == [3, 3]
    assert any(r.fits_matches for rounds in made.run.schedule.steps for r in rounds)
    full = a_run(gradient="full", plan=UpdatePlan(1, 0.0, 0.1))
    full.run.begin(torch.tensor([9, 3]))
    assert not any(r.fits_matches for rounds in full.run.schedule.steps for r in rounds)
    assert full.run._denoiser is not None and made.run._denoiser is None


@pytest.mark.parametrize("current", [True, False])
@pytest.mark.parametrize("tiny", [None, "tiny"])
@pytest.mark.parametrize("read", [True, False])
def test_the_result_starts_from_a_current_map_unless_the_tiny_decoder_made_it(steps, current, tiny, read):
    """That decodes the map of every step whose latent is read: of all but the last, or of all."""
    made = a_run(tiny=tiny, match_fits=2)
    made.run._reads_latents = read
    steps.current = current
    run = made.run
    run.begin(torch.tensor([9, 3]))
    kept = []
    for t in (9, 3):
        run.guide(latents(), torch.tensor(t), latents())
        run.after_step(torch.tensor(t), latents())
        kept.append(run._results[-1] is not None)
    is_read = [True, read]
    assert kept == [current and (tiny is None or not each) for each in is_read]


def test_a_step_that_is_not_guided_has_no_map_for_the_result(steps):
    made = a_run(guidance_end=0.5, match_fits=1)
    made.run.begin(torch.tensor([9, 3]))
    for t in (9, 3):
        made.run.guide(latents(), torch.tensor(t), latents())
        assert (made.run._results[-1] is not None) == (t == 9)
        made.run.after_step(torch.tensor(t), latents())


@pytest.mark.parametrize(
    ("parameters", "moved"), [({"step_from": "updated"}, True), ({"step_from": "given"}, False)]
)
def test_the_move_is_given_to_the_estimate_as_configured(steps, parameters, moved):
    made = a_run(plan=UpdatePlan(1, 0.0, 0.1), **parameters)
    made.run.begin(torch.tensor([9]))
    assert made.run.guide(latents(), torch.tensor(9), latents()).offset == ("move", moved)
    still = a_run(plan=UpdatePlan(1, 0.0, 0.1), optimize_latents=False, **parameters)
    still.run.begin(torch.tensor([9]))
    output, z_t = latents(), latents(seed=1)
    inputs = still.run.guide(output, torch.tensor(9), z_t)
    assert inputs.output is output and inputs.z_t is z_t and inputs.offset is None


def test_final_maps_are_decoded_chunk_by_chunk_where_no_map_is_kept(steps):
    made = a_run(batch=2, match_fits=1)
    run = made.run
    for k, current in enumerate((True, False, True)):
        steps.current = current
        run.begin(torch.tensor([9]))
        run.guide(latents(), torch.tensor(9), latents())
        run.after_step(torch.tensor(9), latents())
        run.trajectories[k].affine.scale = torch.tensor(1.0 + k)
    for k in range(3):
        z = latents(seed=k)
        depth_m = run.metric_prediction(z)
        x = torch.full((2, 1, 4, 6), 1.0 + k) if k != 1 else z[:, CHANNELS].mean(1, keepdim=True)
        padded = GRID.padded(x)
        torch.testing.assert_close(depth_m, (1.0 + k) * padded + 7.0)
        assert depth_m.dtype == torch.float32 and depth_m.shape == (2, 1, 6, 7)
        for i, (member_x, member_m) in enumerate(run.members[2 * k : 2 * k + 2]):
            torch.testing.assert_close(member_x, padded[i : i + 1, :, :4, :6])
            torch.testing.assert_close(member_m, depth_m[i : i + 1])
    assert len(run.members) == 6


def test_a_callback_sees_the_latest_guided_step_and_the_decoded_end(steps):
    seen, hooked = [], []

    def callback(pipe, i, t, values):
        hooked.append("_guided_run" in vars(pipe))
        seen.append((pipe, i, int(t), dict(values)))

    made = a_run(callback=callback, match_fits=2, guidance_start=0.3)
    run = made.run
    with run:
        assert vars(made.pipe)["_guided_run"] is run
        run.begin(torch.tensor([9, 6, 3]))
        for k, t in enumerate((9, 6, 3)):
            run.guide(latents(), torch.tensor(t), latents())
            run.after_step(torch.tensor(t), latents(seed=k))
            assert vars(made.pipe)["_guided_run"] is run
    assert hooked == [False] * 3 and "_guided_run" not in vars(made.pipe)
    assert [each[:3] for each in seen] == [(made.pipe, 0, 9), (made.pipe, 1, 6), (made.pipe, 2, 3)]
    assert set(seen[0][3]) == {"latents", "metric_depth", "loss", "scale", "shift"}
    assert [name for name, value in seen[0][3].items() if value is not None] == ["latents"]
    for k, values in ((1, seen[1][3]), (2, seen[2][3])):
        assert torch.equal(values["latents"], latents(seed=k))
        assert (values["scale"], values["shift"], values["loss"][0]) == (2.0, 7.0, 0.5 * k)
    torch.testing.assert_close(seen[1][3]["metric_depth"], torch.full((2, 1, 4, 6), 2.0 * 1 + 7.0))
    ((z0, final),) = made.decoded
    assert final and torch.equal(z0, latents(seed=2)[:, CHANNELS])
    torch.testing.assert_close(seen[2][3]["metric_depth"], 2.0 * z0.sum(1, keepdim=True) + 7.0)


@pytest.mark.parametrize("how", ["nothing", "same", "returned", "in place", "elsewhere"])
def test_latents_that_a_callback_changes_are_decoded_again(steps, how):
    def callback(pipe, i, t, values):
        if how == "same":
            return {"latents": values["latents"].clone()}
        if how == "returned":
            return {"latents": values["latents"].double() + 1.0}
        if how == "in place":
            values["latents"] += 1.0
        return {"other": 1} if how == "elsewhere" else None

    made = a_run(callback=callback, match_fits=1)
    made.run.begin(torch.tensor([9]))
    made.run.guide(latents(), torch.tensor(9), latents())
    given = latents()
    found = made.run.after_step(torch.tensor(9), given)
    changed = how in ("returned", "in place")
    torch.testing.assert_close(found, latents() + changed)
    assert (made.run._results[-1] is None) == changed and found.dtype == torch.float32


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (3, r"^the return value of callback_on_step_end must be a dict or None; got int\. Return"),
        (
            {"latents": torch.zeros(2, 5, 3, 3)},
            r"^latents in the return value .* a tensor of shape \(2, 5, 3, 4\); got \(2, 5, 3, 3\)\. Return",
        ),
        ({"latents": "x"}, "got str"),
        (
            {"latents": torch.full((2, 5, 3, 4), torch.inf)},
            r"^latents in the return value of callback_on_step_end must be finite; "
            r"got NaN or infinity\. Return",
        ),
    ],
)
def test_answers_that_are_no_latents_are_rejected(answer, message):
    with pytest.raises((ValueError, TypeError), match=message):
        _latents_of(answer, latents())


def test_hooks_are_in_place_within_the_block_alone(monkeypatch):
    for inner, faster in ((0, True), (2, False)):
        made = a_run(plan=UpdatePlan(inner, 0.0, 0.1), gradient="full" if inner else "denoised")
        if not faster:
            made.pipe._faster = None
        pipe, net = made.pipe, made.codec.prior.net
        ready = torch.full((3, 3, 6, 7), 0.5), GRID.padding, (4, 6)
        made.codec.grid = replace(GRID, preprocessed=ready)
        scheduler = pipe.scheduler
        before = dict(vars(pipe.image_processor))
        with made.run:
            assert net.weight.requires_grad == (inner == 0)
            assert hasattr(pipe, "was_faster") == faster
            assert ("forward" in vars(net)) == bool(inner)
            assert pipe.scheduler is not scheduler and pipe._guided_run is made.run
            assert vars(pipe.image_processor) != before
            image, *rest = pipe.image_processor.preprocess(made.call["image"])
            assert torch.equal(image, ready[0]) and tuple(rest) == ready[1:]
        assert net.weight.requires_grad and not hasattr(pipe, "was_faster") and "forward" not in vars(net)
        assert pipe.scheduler is scheduler and not hasattr(pipe, "_guided_run")
        assert vars(pipe.image_processor) == before
        made.run.begin(torch.tensor([9]))
        bar = made.run._bar
        closed = []
        bar.close = lambda closed=closed: closed.append(1)
        made.run.release()
        assert closed == [1] and not hasattr(made.run, "_scheduler")


@pytest.mark.parametrize(("samples", "batch", "chunks"), [(6, 4, 2), (6, 3, 2), (6, 6, 1), (2, 4, 1)])
def test_the_bar_counts_the_steps_of_all_chunks_and_shows_the_loss(steps, samples, batch, chunks):
    made = a_run(images=samples // 2, batch=batch, match_fits=2)
    made.pipe._progress_bar_config = {"disable": False, "leave": False, "file": open("/dev/null", "w")}  # noqa: SIM115
    run, shown = made.run, []
    for _ in range(chunks):
        run.begin(torch.tensor([9, 6, 3]))
        run._bar.set_postfix = lambda refresh, **values: shown.append((values, refresh))
        for t in (9, 6, 3):
            run.guide(latents(), torch.tensor(t), latents())
            run.after_step(torch.tensor(t), latents())
    assert run._bar.total == run._bar.n == 3 * chunks and run._bar.desc.startswith("guided steps")
    expected = [{"loss": f"{0.5 * number:.4f}"} for number in range(1, 2 * chunks + 1)]
    assert [values for values, _ in shown] == expected and not any(refresh for _, refresh in shown)
    run.release()
    made.pipe._progress_bar_config["file"].close()


def test_the_loss_is_shown_only_if_it_can_be_read_at_once(steps):
    made = a_run(match_fits=1)
    run, shown = made.run, []
    run.begin(torch.tensor([9, 3]))
    run._bar = SimpleNamespace(
        disable=False, update=lambda: None, set_postfix=lambda **each: shown.append(each)
    )
    run.guide(latents(), torch.tensor(9), latents())
    run.after_step(torch.tensor(9), latents())  # not guided: nothing to show
    for disable, loss in ((True, torch.ones(2)), (False, None), (False, torch.ones(2, device="meta"))):
        run._bar.disable, run._step = disable, 1
        run.guide(latents(), torch.tensor(3), latents())
        run.trajectories[0].history[-1].loss = loss
        run.after_step(torch.tensor(3), latents())
    assert shown == []


DOUBT, WARNING = Finding("calibration.assumed-metres", "Metres?"), Finding("image.dark", "Dark.")


@pytest.mark.parametrize("spread", [True, False])
@pytest.mark.parametrize("given", [True, False])
def test_each_image_is_finished_with_its_own_members_map_and_spread(monkeypatch, steps, spread, given):
    finished, stacked = [], {}

    def finish(*arguments):
        finished.append(arguments)
        return f"result {len(finished)}"

    def stack(results, guidance, history, **options):
        stacked.update(results=results, guidance=guidance, history=history, **options)
        return "output"

    monkeypatch.setattr(run_module, "finish", finish)
    monkeypatch.setattr(run_module, "stack_results", stack)
    made = a_run(batch=4, **{"depth_range": (0.5, 9.0)} if given else {})
    run, call = made.run, made.call
    if given:
        made.guidance.unit = None
        call |= {"ensembling_kwargs": {"reduction": "mean"}, "output_type": "np"}
    plans = [SimpleNamespace(complete=lambda name=name: name) for name in ("first", "second", "third")]
    run._plans = lambda: plans
    run.members = list(range(6))
    for k in range(2):
        run.trajectories.append(Trajectory(*range(5)))
        run.trajectories[k].history = [f"{k} a", f"{k} b"]
    maps, spreads = torch.arange(3.0).view(3, 1, 1, 1), 10.0 + torch.arange(3.0).view(3, 1, 1, 1)
    stock = SimpleNamespace(prediction=maps, uncertainty=spreads if spread else None, extras={"normals": 5})
    if not given:
        del stock.extras
    assert run.output(stock, [DOUBT, SAME_CENTRE, WARNING]) == "output"
    for k, (evidence, members, depth_m, its_spread, options) in enumerate(finished):
        assert evidence == ("first", "second", "third")[k] and members == [2 * k, 2 * k + 1]
        assert depth_m.item() == k and (its_spread.item() == 10 + k if spread else its_spread is None)
        assert options.config is made.guidance.config and options.resampling == "bicubic"
        assert options.reduction == ("mean" if given else "median")
        assert options.call == Call(not given, given, (DOUBT, SAME_CENTRE, WARNING)) and options.fill
    assert stacked["results"] == ["result 1", "result 2", "result 3"]
    assert stacked["guidance"] is made.guidance and stacked["history"] == ["0 a", "0 b", "1 a", "1 b"]
    assert stacked["findings"] == [SAME_CENTRE, WARNING] and stacked["as_numpy"] == given
    assert stacked["extras"] == ({"normals": 5} if given else {})
    assert [trajectory.checked for trajectory in run.trajectories] == [[made.pipe]] * 2


def test_tensors_that_are_not_finite_are_reported_also_if_the_result_fails(monkeypatch, steps):
    made = a_run(images=1)
    made.run.members = [1, 2]
    made.run.trajectories.append(Trajectory(*range(5)))

    def fail(*_):
        raise ZeroDivisionError

    def check(pipe):
        raise ValueError("not finite")

    monkeypatch.setattr(run_module, "finish", fail)
    made.run.trajectories[0].watch.check = check
    stock = SimpleNamespace(prediction=torch.ones(1, 1, 1, 1), uncertainty=None)
    with pytest.raises(ValueError, match="not finite"):
        made.run.output(stock, [])
