"""A right view parallel to the left one: where left pixels are on it, what it shows there, and its costs."""

import numpy as np
import pytest
import torch

from geodiff_plugin.cameras import Camera
from geodiff_plugin.matching.alignment import AlignedView, ComparedView, align_view, even_shifts
from geodiff_plugin.matching.census import census, grey_levels
from tests.unit.matching import references as ref

SIZE, SIZE_RIGHT = (40, 56), (50, 44)
K = ref.matrix(61.0, 55.0, 26.0, 21.5, 1.5)
K_RIGHT = ref.matrix(48.0, 66.0, 20.0, 27.0, -2.0)
#: A plane at infinity first, then some that are not evenly spaced.
LEFT = Camera(K, SIZE[::-1])
PLANES = np.array([0.0, 0.1, 0.25, 0.4, 0.7])
POSES = [
    ref.right_from_left((4.0, -6.0, 9.0), (0.25, -0.1, 0.2)),
    ref.right_from_left((-7.0, 3.0, -12.0), (-0.2, 0.15, -0.35)),
]


def aligned(image: np.ndarray, T: np.ndarray, K_right: np.ndarray = K_RIGHT) -> AlignedView:
    return align_view(ref.grey_view(image, K_right, T), LEFT, torch.from_numpy(PLANES).float())


def ramps() -> tuple[np.ndarray, np.ndarray]:
    """Two right images whose brightness is the column and the row of a pixel."""
    rows, columns = np.mgrid[: SIZE_RIGHT[0], : SIZE_RIGHT[1]]
    return 0.1 + columns / 100, 0.1 + rows / 100


@pytest.mark.parametrize("T", POSES)
def test_a_canvas_shows_at_a_left_pixels_place_what_the_right_image_shows_at_its_projection(T):
    by_column, by_row = (aligned(image, T) for image in ramps())
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    checked = 0
    for k, plane in enumerate(PLANES):
        u, v, z = ref.projected(columns, rows, plane, K, K_RIGHT, T)
        inside = (z > 0) & (u > 1) & (u < SIZE_RIGHT[1] - 2) & (v > 1) & (v < SIZE_RIGHT[0] - 2)
        at = by_column.positions(SIZE[0], 1)[k], by_column.positions(SIZE[1], 0)[k]
        for view, expected in ((by_column, u), (by_row, v)):
            shown = 100 * (ref.sampled(view.grey.numpy(), *at, order=3) - 0.1)
            error = (shown - expected)[inside]
            assert abs(error).max() < 0.15 and abs(error.mean()) < 0.01  # torch's cubics make ramps wavy
        seen = np.ix_(by_column.nearest(at[0][None], 1)[0], by_column.nearest(at[1][None], 0)[0])
        assert by_column.valid.numpy()[seen][inside].all()
        checked += inside.sum()
    assert checked > 3000


#: A right camera of so wide an angle that a part of its image lies behind the left one.
WIDE = ref.matrix(14.0, 19.0, 20.0, 27.0), ref.right_from_left((12.0, 48.0, -5.0), (0.2, 0.1, 0.05))


@pytest.mark.parametrize(("K_right", "T", "horizon"), [*((K_RIGHT, T, False) for T in POSES), (*WIDE, True)])
def test_a_canvas_is_valid_inside_the_right_image_and_covers_it_as_far_as_the_planes_show_it(
    K_right, T, horizon
):
    view = aligned(ramps()[0], T, K_right)
    low = -view.shift[0]  # at infinity left pixels are moved by the canvas's origin only
    np.testing.assert_allclose(low, np.round(low), atol=1e-9)
    assert view.scale[0] == 1.0
    rows, columns = np.mgrid[: view.size[0], : view.size[1]]
    u, v, z = ref.projected(columns + low[0], rows + low[1], 0.0, K, K_right, T)

    def within(margin: float) -> np.ndarray:
        in_columns = (u >= -margin) & (u <= SIZE_RIGHT[1] - 1 + margin)
        return in_columns & (v >= -margin) & (v <= SIZE_RIGHT[0] - 1 + margin) & (z > 0)

    valid = view.valid.numpy()
    assert (valid <= within(0.02)).all() and (within(0.0) <= valid).all()
    assert 0.3 < valid.mean() < 1.0
    # The corners of the left grid on every plane, and the outline of the right image, bound the canvas.
    ends = [view.positions(SIZE[1], 0)[:, [0, -1]] + low[0], view.positions(SIZE[0], 1)[:, [0, -1]] + low[1]]
    outline = np.linspace(0, 1, 9)
    edge_u, edge_v = np.meshgrid(outline * (SIZE_RIGHT[1] - 1), outline * (SIZE_RIGHT[0] - 1))
    back = np.linalg.inv(K_right @ T[:3, :3] @ np.linalg.inv(K)) @ np.stack(
        [edge_u.ravel(), edge_v.ravel(), np.ones(81)]
    )
    assert (back[2] < 0).any() == horizon
    for axis, (at, shown) in enumerate(zip(ends, back[:2] / back[2], strict=True)):
        last = SIZE[1 - axis] - 1
        least, most = max(at.min(), -last), min(at.max(), 2 * last)
        if not horizon:
            least, most = max(least, shown.min()), min(most, shown.max())
        assert low[axis] == np.floor(least)
        assert low[axis] + view.size[1 - axis] - 1 == np.ceil(most)


def test_a_canvas_is_at_most_three_left_grids_wide_and_never_empty():
    """Cameras so near to each other's axes that planes spread far, and one that looks past the left grid."""
    wide = ref.grey_view(np.full((300, 400), 0.5), ref.matrix(30.0, 30.0, 200.0, 150.0), POSES[0])
    planes = torch.tensor([0.0, 2.0, 4.6])
    view = align_view(wide, LEFT, planes)
    last = np.array([SIZE[1] - 1, SIZE[0] - 1])
    low = -view.shift[0]
    high = low + np.array(view.size[::-1]) - 1
    assert (low >= -last).all() and (high <= 2 * last).all()
    assert (high - low).max() > 1.5 * last.max()
    narrow = ref.matrix(300.0, 300.0, 28.0, 20.0)
    for yaw, pitch in ((50.0, 0.0), (-50.0, 0.0), (0.0, 45.0), (0.0, -45.0)):
        T = ref.right_from_left((pitch, yaw, 0.0), (0.2, 0.0, 0.0))
        near_infinity = torch.tensor([0.0, 0.1])
        away = align_view(ref.grey_view(np.full(SIZE, 0.5), narrow, T), LEFT, near_infinity)
        axis = 0 if yaw else 1
        assert away.size[1 - axis] == 2


def test_a_canvas_without_a_plane_in_front_of_the_right_camera_covers_the_left_grid():
    T = ref.right_from_left((2.0, 3.0, -4.0), (0.0, 0.1, 1.0))
    view = ref.grey_view(np.full(SIZE_RIGHT, 0.5), ref.matrix(20.0, 20.0, 22.0, 25.0), T)
    made = align_view(view, LEFT, torch.tensor([1.0, 1.5, 3.0]))
    assert made.size == SIZE and not made.scale.any()


def test_a_turned_image_stays_between_black_and_white():
    """A checkerboard, beyond whose values a cubic swings."""
    board = np.mgrid[: SIZE_RIGHT[0], : SIZE_RIGHT[1]].sum(0) // 3 % 2
    grey = aligned(board, POSES[0]).grey
    assert grey.min() == 0.0 and grey.max() == 1.0


def test_depth_over_depth_is_the_scale_and_planes_behind_the_right_camera_have_none():
    """The right camera is half a metre ahead: planes at 0.5 m and nearer are behind it."""
    T = ref.right_from_left((3.0, 5.0, -8.0), (0.1, 0.05, 0.5))
    planes = torch.tensor([0.0, 0.5, 1.5, 1.94, 1.97, 2.0, 2.5])
    view = align_view(ref.grey_view(ramps()[0], K_RIGHT, T), LEFT, planes)
    depth_ratio = 1 - 0.5 * planes.numpy()
    expected = np.where(depth_ratio > 0.02, 1 / np.where(depth_ratio > 0.02, depth_ratio, 1), 0.0)
    np.testing.assert_allclose(view.scale, expected, rtol=1e-5)
    assert (view.scale > 0).tolist() == [True, True, True, True, False, False, False]
    columns = view.positions(SIZE[1], 0)
    assert not view.inside(columns, 0)[4:].any()
    assert (view.sources(SIZE[1], 0)[4:] == SIZE[1]).all()


@pytest.mark.parametrize(
    ("angle_deg", "K_right", "plain"),
    [
        (0.0, K + np.array([[0, 0, 3.25], [0, 0, -1.5], [0, 0, 0]]), True),
        (0.0, ref.matrix(61.5, 55.0, 26.0, 21.5, 1.5), False),
        (0.0, ref.matrix(61.0, 55.5, 26.0, 21.5, 1.5), False),
        (0.01, K, True),
        (0.2, K, False),
    ],
)
def test_a_view_that_turning_would_hardly_move_is_its_own_canvas(angle_deg, K_right, plain):
    T = ref.right_from_left((0.0, angle_deg, 0.0), (0.25, 0.02, 0.0))
    image = np.random.default_rng(0).random(SIZE_RIGHT)
    view = aligned(image, T, K_right)
    assert (view.valid is None) == plain
    if plain:
        np.testing.assert_array_equal(view.grey, np.float32(image))
        for k, plane in enumerate(PLANES):
            u, v, _ = ref.projected(np.arange(SIZE[1]), np.full(SIZE[1], 7.0), plane, K, K_right, T)
            np.testing.assert_allclose(view.positions(SIZE[1], 0)[k], u, atol=0.02)
            np.testing.assert_allclose(view.positions(SIZE[0], 1)[k, 7], v[0], atol=0.02)


def scaled_view(count: int, valid: bool) -> AlignedView:
    """A random canvas on which planes are scaled and moved, one of them behind the right camera."""
    rng = np.random.default_rng(3)
    canvas = rng.random((33, 47))
    scale, shift = rng.uniform(0.7, 1.4, count), rng.uniform(-12, 12, (count, 2))
    scale[2] = 0.0
    mask = torch.from_numpy(rng.random(canvas.shape) < 0.7) if valid else None
    return AlignedView(torch.from_numpy(canvas).float(), mask, scale, shift, masked=False)


def shifted_view(valid: bool) -> AlignedView:
    """Planes that are shifts by eighths of a pixel along the rows, and by quarters across them."""
    rng = np.random.default_rng(4)
    canvas, count = rng.random((33, 47)), 40
    shift = np.stack([rng.integers(-160, 120, count) / 8, 1.25 + rng.integers(0, 4, count) / 4], 1)
    shift[[5, 11], 0] = -95.0, 90.0  # further than the canvas: its repeated edge alone
    mask = torch.from_numpy(rng.random(canvas.shape) < 0.7) if valid else None
    return AlignedView(torch.from_numpy(canvas).float(), mask, np.ones(count), shift, masked=False)


@pytest.mark.parametrize("valid", [False, True])
@pytest.mark.parametrize("make", [lambda valid: scaled_view(6, valid), shifted_view])
def test_costs_and_visible_pixels_of_every_plane_equal_a_warp_by_that_plane(make, valid):
    view, (height, width) = make(valid), (24, 31)
    left = np.random.default_rng(5).random((height + 6, width + 6))
    compared = ComparedView(census(grey_levels(torch.from_numpy(left).float())), view)
    canvas, described = view.grey.numpy(), ref.votes(left)
    for k, (scale, (across, down)) in enumerate(zip(view.scale, view.shift, strict=True)):
        columns, rows = scale * np.arange(width) + across, scale * np.arange(height) + down
        # The margin of the left grid repeats its outermost lines.
        wide = (np.pad(lines, 3, mode="edge") for lines in (rows, columns))
        expected = ref.cost(described, ref.votes(ref.sampled(canvas, *wide)))
        inner = slice(3, width - 3)  # plain shifts have the true columns next to the grid
        error = np.abs(compared.cost(k).numpy().astype(int) - expected)[:, inner]
        assert error.max() <= 3 and error.mean() < 0.05
        inside = [
            (lines > -0.01) & (lines < last - 0.99) & (scale > 0)
            for lines, last in ((rows, canvas.shape[0]), (columns, canvas.shape[1]))
        ]
        seen = inside[0][:, None] & inside[1]
        if valid:
            nearest = [np.rint(lines).clip(0, 1e9).astype(int) for lines in (rows, columns)]
            nearest = [np.minimum(lines, last - 1) for lines, last in zip(nearest, canvas.shape, strict=True)]
            seen = seen & view.valid.numpy()[np.ix_(*nearest)]
        np.testing.assert_array_equal(compared.seen(k), seen)


def test_the_left_line_of_a_canvas_line_is_the_one_that_comes_nearest_to_it():
    view = scaled_view(6, False)
    for axis, count in ((0, 31), (1, 24)):
        for k, source in enumerate(view.sources(count, axis)):
            assert len(source) == (47, 33)[axis]
            at = view.scale[k] * np.arange(count) + view.shift[k, axis]
            for line, found in enumerate(source):
                apart = np.abs(at - line) if view.scale[k] else np.full(count, np.inf)
                if found == count:
                    assert apart.min() > 0.499 * view.scale[k]
                else:
                    assert apart[found] == apart.min() <= 0.501 * view.scale[k]


def test_only_planes_that_are_shifts_to_an_eighth_of_a_pixel_are_taken_for_shifts():
    rng, count, width = np.random.default_rng(6), 32, 31
    canvas = torch.from_numpy(rng.random((33, 47))).float()
    shift = np.stack([np.linspace(-9, 14, count), np.linspace(0.2, 1.15, count)], 1)

    def taken(scale=1.0, drift=1.0, planes=count) -> bool:
        changed = (shift * [1.0, drift])[:planes]
        return (
            even_shifts(AlignedView(canvas, None, np.full(planes, scale), changed, masked=False), width)
            is not None
        )

    assert taken() and not taken(planes=31)
    assert taken(drift=1.05) and not taken(drift=1.06)
    for sign in (1, -1):
        assert taken(scale=1 + sign * 0.124 / width) and not taken(scale=1 + sign * 0.126 / width)
    found = even_shifts(AlignedView(canvas, None, np.ones(count), shift, masked=False), width)
    np.testing.assert_allclose(np.array(found.columns) / 8, shift[:, 0], atol=1 / 16)
    np.testing.assert_allclose(np.array(found.rows) / 4, shift[:, 1], atol=1 / 8)
