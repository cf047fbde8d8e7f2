"""What each view gets from the other: its confident points, where the view itself is not confident."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from geodiff_plugin import InputError, guide_both_views
from geodiff_plugin.types import MetricDepthOutput
from tests.conftest import render_plane

SIZES = {"left": (48, 64), "right": (40, 56)}
K = {
    "left": np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]),
    "right": np.array([[52.0, 0, 27.5], [0, 52.0, 19.5], [0, 0, 1]]),
}
#: Turned and sideways, so that no two frames can be taken for each other.
E = np.array([[0.995, 0, -0.0998, 0.3], [0, 1, 0, 0.02], [0.0998, 0, 0.995, 0.05], [0, 0, 0, 1.0]])
NORMAL, OFFSET = np.array([0.25, -0.35, 1.0]), 2.0
#: Rows and columns of which a view is not sure.
UNSURE = {"left": (slice(10, 30), slice(20, 40)), "right": (slice(5, 15), slice(30, 50))}


class FakePipeline:
    """Answers with the exact depth of a plane, and says of which part it is not sure."""

    def __init__(self) -> None:
        self.rescaled = 1.0  # metres of a metric prior over the lengths of E
        poses = {"left": np.eye(4), "right": E}
        self.images, self.depth_m, self.calls = {}, {}, []
        for name, size in SIZES.items():
            image, depth_m = render_plane(K[name], poses[name], size, NORMAL, OFFSET, 0)
            self.images[name], self.depth_m[name] = image, torch.from_numpy(depth_m)[None, None]

    def __call__(self, image, guidance, **options) -> MetricDepthOutput:
        name = next(name for name, own in self.images.items() if own is image)
        self.calls.append((name, guidance, options))
        confidence = torch.full_like(self.depth_m[name], 0.9)
        confidence[(..., *UNSURE[name])] = 0.5
        again = [call for call, _, _ in self.calls].count(name) > 1
        depth_m = self.rescaled * (self.depth_m[name] + 10.0 * again)
        return MetricDepthOutput(
            prediction=depth_m, confidence=confidence, warnings=[name], rescaled=self.rescaled
        )


@pytest.fixture
def pipe():
    return FakePipeline()


def guide(pipe, **options):
    images = pipe.images["left"], pipe.images["right"]
    return guide_both_views(pipe, *images, (K["left"], K["right"]), E, min_confidence=0.8, **options)


def test_four_calls_with_the_other_view_and_its_camera(pipe):
    left, right = guide(pipe, knobs={"inner_steps": 3}, output_type="np", num_inference_steps=2)
    assert [name for name, _, _ in pipe.calls] == ["left", "right", "left", "right"]
    assert left.warnings == ["left"] and right.warnings == ["right"]
    assert float(left.prediction.min()) > 10.0 and float(right.prediction.min()) > 10.0  # the second answers
    for name, guidance, options in pipe.calls:
        other = "right" if name == "left" else "left"
        rig = guidance.rigs[0]
        assert guidance.rights[0].shape[-2:] == SIZES[other] and guidance.config.updates.inner_steps == 3
        np.testing.assert_allclose(rig.K_left, K[name])
        np.testing.assert_allclose(rig.K_right, K[other])
        np.testing.assert_allclose(rig.E, E if name == "left" else np.linalg.inv(E), atol=1e-3)
        assert options["num_inference_steps"] == 2 and options["match_input_resolution"]
    assert [options["output_type"] for _, _, options in pipe.calls] == ["pt", "pt", "np", "np"]
    assert [guidance.points_measured for _, guidance, _ in pipe.calls] == [True, True, False, False]


@pytest.mark.parametrize("rescaled", [1.0, 4.0])
def test_only_what_is_sure_there_and_not_here_is_told_at_its_true_place(pipe, rescaled):
    """In the lengths of E, also where the prior alone knows the metres."""
    pipe.rescaled = rescaled
    guide(pipe, knobs={"unit": None} if rescaled != 1.0 else None)
    assert all(own.points is None for _, guidance, _ in pipe.calls[:2] for own in guidance.inputs)
    for name, guidance, _ in pipe.calls[2:]:
        points = guidance.inputs[0].points.double().numpy()
        seen = points @ K[name].T
        column, row = (np.rint(seen[:, i] / seen[:, 2]).astype(int) for i in (0, 1))
        rows, columns = UNSURE[name]
        assert len(points) > 50
        assert ((row >= rows.start) & (row < rows.stop)).all()
        assert ((column >= columns.start) & (column < columns.stop)).all()
        # In this view's frame they lie on the plane.
        world = points if name == "left" else points @ E[:3, :3].T + E[:3, 3]
        np.testing.assert_allclose(world @ NORMAL, OFFSET, atol=2e-3)
        # None of them comes from what the other view is itself not sure of.
        other = "right" if name == "left" else "left"
        pose = np.linalg.inv(E) if other == "right" else np.eye(4)
        there = (world @ pose[:3, :3].T + pose[:3, 3]) @ K[other].T
        column, row = (np.rint(there[:, i] / there[:, 2]).astype(int) for i in (0, 1))
        rows, columns = UNSURE[other]
        unsure = (row >= rows.start) & (row < rows.stop) & (column >= columns.start) & (column < columns.stop)
        assert not unsure.any()


def test_nothing_is_told_where_the_view_is_sure_itself(pipe, monkeypatch):
    for name in UNSURE:
        monkeypatch.setitem(UNSURE, name, (slice(0, 0), slice(0, 0)))
    guide(pipe)
    assert all(own.points is None for _, guidance, _ in pipe.calls for own in guidance.inputs)


def test_points_outside_of_the_other_image_are_left_out(pipe, monkeypatch):
    """A view that is sure of nothing is told what falls into it, and no more."""
    monkeypatch.setitem(UNSURE, "left", (slice(None), slice(None)))
    guide(pipe)
    points = pipe.calls[2][1].inputs[0].points.double().numpy()
    seen = points @ K["left"].T
    uv = np.rint(seen[:, :2] / seen[:, 2:])
    assert (uv >= 0).all() and (uv < np.array([64, 48])).all() and (points[:, 2] > 0).all()
    # The right view reaches beyond the left one, so some of its points were left out.
    assert len(points) < np.prod(SIZES["right"]) - 10 * 20


@pytest.mark.parametrize("name", ["points", "previous"])
def test_what_belongs_to_one_view_is_refused(pipe, name):
    with pytest.raises(InputError, match=name):
        guide(pipe, knobs={name: None})
