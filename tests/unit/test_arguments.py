"""What callers from Python give: numbers, points and scenes are taken in any sensible form or refused in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import radiosity
import workbench
from workbench.arrays import as_count, as_fraction, as_places, as_positive
from workbench.errors import InputError, OptionError, SceneError
from workbench.scene.library import unit_cube

SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
ABOVE = [[0, 1, 1], [1, 1, 1], [1, 0, 1], [0, 0, 1]]


@pytest.mark.parametrize("value", [3, 3.0, np.int32(3), np.float64(3.0)])
def test_whole_numbers_of_any_type_count(value):
    assert as_count(value, "n") == 3 and isinstance(as_count(value, "n"), int)


@pytest.mark.parametrize("value", [1.5, "3", None, np.nan, np.inf, [3], 0, -1])
def test_what_is_no_count_is_refused(value):
    with pytest.raises(OptionError, match=r"^n: found .*, expected .*1 or more$"):
        as_count(value, "n")


@pytest.mark.parametrize("value", ["0.5", None, np.nan, np.inf, 0, 1, -0.5, [0.1, 0.2]])
def test_what_is_no_fraction_is_refused(value):
    with pytest.raises(OptionError, match=r"^e: found .*, expected a number between 0 and 1$"):
        as_fraction(value, "e")
    if value not in (1,):
        with pytest.raises(OptionError, match=r"^l: found .*, expected a positive length$"):
            as_positive(value if value != [0.1, 0.2] else "x", "l", "a positive length")


def test_one_normal_serves_all_points():
    points, normals = as_places([[0, 0, 0], [1, 0, 0]], [0, 0, 2])
    assert points.shape == normals.shape == (2, 3) and (normals == [0, 0, 1]).all()


@pytest.mark.parametrize(
    ("points", "normals", "pattern"),
    [
        ([[0, 0, np.nan]], [0, 0, 1], "points: row 0 is not finite"),
        ([[0, np.inf, 0]], [0, 0, 1], "points: row 0 is not finite"),
        ([[0, 0]], [0, 0, 1], r"points: found shape \(1, 2\)"),
        (np.empty((0, 3)), [0, 0, 1], "points: found none"),
        ("abc", [0, 0, 1], "points: expected numbers"),
        ([[0, 0, 0]], [0, 0, 0], "normals: row 0 has length zero"),
        ([[0, 0, 0]] * 3, [[0, 0, 1]] * 2, "normals: found 2 rows for 3 points"),
    ],
)
def test_bad_sensors_are_refused_in_one_line(points, normals, pattern):
    solution = radiosity.solve(unit_cube(0.0, 1.0), elements=6)
    for ask in (
        lambda: solution.irradiance(points, normals),
        lambda: radiosity.solve(unit_cube(0.0, 1.0), error=0.1, at=(points, normals)),
    ):
        with pytest.raises(InputError, match=pattern) as caught:
            ask()
        assert "\n" not in str(caught.value)


def test_a_solve_takes_what_load_takes():
    by_name = radiosity.solve("hinged-blocker", elements=20)
    folder = Path(workbench.load("hinged-blocker").path)
    np.testing.assert_array_equal(by_name.radiosity, radiosity.solve(folder, elements=20).radiosity)
    factors = radiosity.view_factors("hinged-blocker", by="surface", error=0.01)
    assert factors.names == radiosity.view_factors(workbench.load(folder), by="surface", error=0.01).names
    scene = unit_cube(0.5, 1.0)
    assert workbench.load(scene) is scene


@pytest.mark.parametrize("given", ["ofice", "absent.toml", None, 5, ["office"]])
@pytest.mark.parametrize("ask", [radiosity.solve, radiosity.view_factors])
def test_what_is_no_scene_is_refused_in_one_line(ask, given):
    pattern = "expected a Scene|did you mean 'office'|no such file|cannot be read"
    with pytest.raises(SceneError, match=pattern) as caught:
        ask(given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "options",
    [
        {"error": "x"},
        {"error": np.nan},
        {"error": 1},
        {"error": 0.1, "budget_seconds": "soon"},
        {"budget_seconds": 0},
        {"elements": 1.5},
        {"elements": "many"},
        {"max_edge": "long"},
        {"max_edge": np.nan},
        {"rays": 2.5},
        {"seed": -1},
        {"seed": "x"},
        {"workers": 0},
        {"tolerance": "x"},
        {"form_factor_error": 2},
        {"method": "hierarchical", "link_error": "x"},
        {"method": "guess"},
        {"bundles": "none"},
    ],
)
def test_a_bad_option_of_a_solve_is_refused_in_one_line(options):
    name = list(options)[-1]
    with pytest.raises(OptionError, match=rf"^{name}: found .*, expected ") as caught:
        radiosity.solve(unit_cube(0.5, 1.0), **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        ({"polygon_a": SQUARE[:2]}, "polygon_a"),
        ({"polygon_a": [[0, 0], [1, 0], [1, 1]]}, "polygon_a"),
        ({"polygon_b": [[0, 0, np.nan], [1, 0, 1], [1, 1, 1]]}, "polygon_b"),
        ({"polygon_b": "square"}, "polygon_b"),
        ({"polygon_b": 5}, "polygon_b"),
        ({"polygon_b": [[0, 0, 1], [1, 0, 1], [2, 0, 1]]}, "polygon_b"),
        ({"polygon_b": [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1.5]]}, "polygon_b"),
        ({"occluders": [SQUARE[:2]]}, r"occluders\[0\]"),
        ({"occluders": [5]}, r"occluders\[0\]"),
        ({"occluders": SQUARE}, "occluders"),
        ({"occluders": 5}, "occluders"),
        ({"error": 0}, "error"),
        ({"error": "x"}, "error"),
    ],
)
def test_bad_polygons_of_a_form_factor_are_refused_in_one_line(change, pattern):
    with pytest.raises(InputError, match=pattern) as caught:
        radiosity.form_factor(**({"polygon_a": SQUARE, "polygon_b": ABOVE} | change))
    assert "\n" not in str(caught.value)
