"""The registry, the options, grey values as pattern, and functions of the user's."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from mixpose.errors import RecordingError, SessionError
from mixpose.extraction import METHODS, ExtractOptions, check_options, extract, extract_together
from mixpose.extraction.threshold import RULES, Window
from mixpose.records import GridPattern, Image, PointPattern

GRADIENT = np.arange(48, dtype=np.uint8).reshape(6, 8)


def lit_square() -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    image = np.random.default_rng(0).integers(19, 22, (100, 120), dtype=np.uint8)
    image[40:50, 60:75] = 120
    return image


# Intensity


@pytest.mark.parametrize("threshold", [*RULES, 60.0])
def test_intensity_keeps_the_grey_of_features_without_the_background(
    threshold: str | float,
) -> None:
    pattern = extract(lit_square(), ExtractOptions(method="intensity", threshold=threshold))
    assert isinstance(pattern, GridPattern)
    assert pattern.values.dtype == np.float32
    assert pattern.values.shape == (100, 120)
    assert pattern.step == 1.0
    np.testing.assert_array_equal(pattern.origin, [0, 0])
    # "local" and "sauvola" take the square itself for part of the background: of the box that
    # they take the mean of, the square fills up to all.
    if threshold not in ("local", "sauvola"):
        np.testing.assert_allclose(pattern.values[40:50, 60:75], 100, atol=1.5)
    assert pattern.values[40:50, 60:75].any()
    outside = pattern.values.copy()
    outside[40:50, 60:75] = 0
    assert not outside.any()


def test_intensity_of_spots_keeps_their_tails() -> None:
    image = np.random.default_rng(0).integers(19, 22, (100, 120), dtype=np.uint8)
    rows, columns = np.mgrid[:100, :120]
    width = np.zeros(2)
    spot = 100 * np.exp(-((rows - 50) ** 2 + (columns - 60) ** 2) / (2 * 5.0**2))
    for k, spot_sigma in enumerate((0.0, 5.0)):
        options = ExtractOptions(method="intensity", spot_sigma=spot_sigma)
        pattern = extract(np.rint(image + spot).astype(np.uint8), options)
        assert isinstance(pattern, GridPattern)
        squares = pattern.values * (columns - 60) ** 2
        width[k] = np.sqrt(squares.sum() / pattern.total)
        assert not pattern.values[:20].any()
    # cut off at 8 % of its height a spot has lost a tenth of its width
    assert width[0] < 4.5
    # of the noise around it what is above zero is left, and adds a little
    assert width[1] == pytest.approx(5.1, abs=0.2)


def test_intensity_of_dark_features_is_how_much_darker_they_are() -> None:
    image = np.asarray(255 - lit_square(), dtype=np.uint8)
    for threshold in ("auto", 200.0):
        options = ExtractOptions(method="intensity", polarity="dark", threshold=threshold)
        pattern = extract(image, options)
        assert isinstance(pattern, GridPattern)
        assert np.count_nonzero(pattern.values) == 150
        assert pattern.values.max() == pytest.approx(100, abs=1.5)


def test_intensity_of_a_window_starts_at_its_corner() -> None:
    window = (50, 30, 90, 60)
    pattern = extract(lit_square(), ExtractOptions(method="intensity"), window=window)
    assert isinstance(pattern, GridPattern)
    assert pattern.values.shape == (30, 40)
    np.testing.assert_array_equal(pattern.origin, [50, 30])
    assert np.count_nonzero(pattern.values) == 150
    assert pattern.values[10:20, 10:25].min() > 90


def test_intensity_without_features_is_an_empty_pattern() -> None:
    pattern = extract(np.full((30, 40), 9, np.uint8), ExtractOptions(method="intensity"))
    assert isinstance(pattern, PointPattern)
    assert pattern.points.shape == (0, 2)


def test_a_slope_of_light_below_a_feature_is_taken_out_in_every_window() -> None:
    v, u = np.mgrid[:200.0, :240.0]
    image = (20 + 0.3 * u + 0.2 * v).astype(np.float32)
    image[97:103, 116:124] += 100
    for u0, v0, u1, v1 in ((0, 0, 240, 200), (85, 70, 240, 200), (110, 90, 130, 110)):
        options = ExtractOptions(method="intensity")
        pattern = extract(image, options, window=(u0, v0, u1, v1))
        assert isinstance(pattern, GridPattern)
        # from one tile of 40 px to the next the slope rises by 12
        lit = pattern.values[97 - v0 : 103 - v0, 116 - u0 : 124 - u0]
        np.testing.assert_allclose(lit, 100, atol=1.0)


# Options and images


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (ExtractOptions(method="blob"), "extract.method: 'blob' .*did you mean 'blobs'"),
        (ExtractOptions(method="sift"), "extract.method: 'sift' .*'module:function'"),
        (ExtractOptions(polarity="white"), "extract.polarity: 'white'.*dark"),  # type: ignore[arg-type]
        (
            ExtractOptions(threshold="adaptive"),
            "extract.threshold: 'adaptive'.*'local', 'li', 'triangle', 'sauvola' and a grey level",
        ),
        (ExtractOptions(threshold=float("nan")), "extract.threshold: nan"),
        (ExtractOptions(threshold=True), "extract.threshold: True"),
        (ExtractOptions(min_area=-1), "extract.min_area: -1"),
        (ExtractOptions(min_area=50, max_area=20), "extract.max_area: 20.*min_area = 50"),
        (ExtractOptions(sigma=0), "extract.sigma: 0"),
    ],
)
def test_wrong_options_are_one_line_with_the_key(options: ExtractOptions, message: str) -> None:
    for call in (lambda: check_options(options), lambda: extract(GRADIENT, options)):
        with pytest.raises(SessionError, match=message) as error:
            call()
        assert "\n" not in str(error.value)


def test_every_method_of_the_registry_is_sound() -> None:
    for method in METHODS:
        check_options(ExtractOptions(method=method))
        extract(lit_square(), ExtractOptions(method=method))


@pytest.mark.parametrize(
    "image",
    [np.zeros((4, 5, 3), np.uint8), np.zeros(4, np.uint8), np.zeros((4, 5)), np.zeros((4, 5), int)],
)
def test_other_images_are_refused(image: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> None:
    with pytest.raises(RecordingError, match=r"shape .* type .*uint8, uint16 or float32"):
        extract(image, ExtractOptions())


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("method", METHODS)
def test_values_that_are_no_numbers_are_refused(value: float, method: str) -> None:
    image = np.zeros((40, 50), np.float32)
    image[20, 30] = value
    with pytest.raises(RecordingError, match="NaN or infinite"):
        extract(image, ExtractOptions(method=method))


# Functions of the user's


def write_module(folder: Path, name: str, text: str) -> None:
    (folder / f"{name}.py").write_text(text, encoding="utf-8")


def test_function_beside_the_session_file_gets_image_and_options(tmp_path: Path) -> None:
    write_module(tmp_path, "neighbour", "SCALE = 2.0\n")
    write_module(
        tmp_path,
        "mine",
        "import numpy as np\nfrom neighbour import SCALE\n"
        "def find(image, options):\n"
        "    v, u = np.unravel_index(np.argmax(image), image.shape)\n"
        "    return [[u, v, SCALE * options.sigma]]\n",
    )
    path = list(sys.path)
    options = ExtractOptions(method="mine:find", sigma=0.75)
    check_options(options, base=tmp_path)
    pattern = extract(GRADIENT, options, base=tmp_path)
    assert isinstance(pattern, PointPattern)
    np.testing.assert_array_equal(pattern.points, [[7, 5]])
    np.testing.assert_array_equal(pattern.weights, [1.5])
    moved = extract(GRADIENT, options, window=(2, 1, 5, 4), base=tmp_path)
    assert isinstance(moved, PointPattern)
    np.testing.assert_array_equal(moved.points, [[4, 3]])
    assert sys.path == path


def test_function_may_return_patterns(tmp_path: Path) -> None:
    write_module(
        tmp_path,
        "patterns",
        "import numpy as np\nfrom mixpose.records import GridPattern, Image, PointPattern\n"
        "def points(image, options):\n"
        "    return PointPattern(np.array([[1.0, 2.0]]), np.array([3.0]))\n"
        "def grid(image, options):\n"
        "    return GridPattern(image.astype('f4'), np.zeros(2), 1.0)\n"
        "def nothing(image, options):\n    return []\n",
    )
    window = (2, 1, 6, 5)
    points, grid, nothing = (
        extract(GRADIENT, ExtractOptions(method=f"patterns:{name}"), window=window, base=tmp_path)
        for name in ("points", "grid", "nothing")
    )
    assert isinstance(points, PointPattern)
    np.testing.assert_array_equal(points.points, [[3, 3]])
    assert isinstance(grid, GridPattern)
    np.testing.assert_array_equal(grid.origin, [2, 1])
    np.testing.assert_array_equal(grid.values, GRADIENT[1:5, 2:6])
    assert isinstance(nothing, PointPattern)
    assert nothing.points.shape == (0, 2)


def test_modules_of_one_name_in_two_folders_do_not_mix(tmp_path: Path) -> None:
    for number in (1, 2):
        folder = tmp_path / str(number)
        folder.mkdir()
        write_module(folder, "same", f"def f(image, options):\n    return [[{number}, 0]]\n")
        pattern = extract(GRADIENT, ExtractOptions(method="same:f"), base=folder)
        assert isinstance(pattern, PointPattern)
        np.testing.assert_array_equal(pattern.points, [[number, 0]])


@pytest.mark.parametrize(
    ("method", "text", "message"),
    [
        ("absent:f", "", "no module 'absent'"),
        ("mod:g", "def f(i, o): return []", "no function 'g'"),
        ("mod:f", "f = 3", "no function 'f'"),
        ("mod:f", "def f(:", "cannot be imported: SyntaxError"),
        ("mod:f", "import not_there_at_all", "cannot be imported: ModuleNotFoundError"),
        ("mod:f", "1 / 0", "cannot be imported: ZeroDivisionError"),
        ("mod:f", "def f(i, o): raise ValueError('two\\nlines')", "failed: ValueError: two lines"),
        ("mod:f", "def f(i): return []", "failed: TypeError"),
        ("mod:f", "def f(i, o): return None", r"allowed are a PointPattern"),
        ("mod:f", "def f(i, o): return 'text'", "returned str"),
        ("mod:f", "def f(i, o): return [[1.0]]", r"shape \(1, 1\)"),
        ("mod:f", "def f(i, o): return [[1.0, float('nan')]]", "NaN"),
        ("mod:f", "def f(i, o): return [[1.0, 2.0, -1.0]]", "not positive"),
        ("mod: f", "", "form 'module:function'"),
    ],
)
def test_wrong_functions_are_one_line(tmp_path: Path, method: str, text: str, message: str) -> None:
    write_module(tmp_path, "mod", text + "\n")
    with pytest.raises(SessionError, match=message) as error:
        extract(GRADIENT, ExtractOptions(method=method), base=tmp_path)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith("extract.method: ")


def test_function_of_an_installed_module_needs_no_folder() -> None:
    with pytest.raises(SessionError, match="json:dumps"):
        extract(GRADIENT, ExtractOptions(method="json:dumps"))
    check_options(ExtractOptions(method="json:dumps"))


# Several images


def test_images_that_are_looked_at_together_hold_what_each_holds_alone() -> None:
    disks = np.random.default_rng(1).integers(19, 22, (160, 200), dtype=np.uint8)
    yy, xx = np.mgrid[:160, :200]
    for u, v, radius in ((40.3, 50.7, 12), (120.6, 80.2, 15), (60.1, 120.4, 9)):
        disks[(xx - u) ** 2 + (yy - v) ** 2 < radius**2] = 180
    dark = np.asarray(255 - disks[::-1], dtype=np.uint8)
    asked: dict[str, tuple[Image, ExtractOptions, Window | None]] = {
        "disks": (disks, ExtractOptions(), None),
        "square": (lit_square(), ExtractOptions(method="intensity"), (50, 30, 90, 60)),
        "dark": (dark, ExtractOptions(polarity="dark", max_area=500.0), None),
        "outside": (disks, ExtractOptions(), (300, 0, 400, 100)),
        "part": (disks, ExtractOptions(), (80, 40, 200, 160)),
    }
    for name, found in extract_together(asked).items():
        image, options, window = asked[name]
        alone = extract(image, options, window=window)
        if isinstance(found, PointPattern):
            assert isinstance(alone, PointPattern)
            assert len(found.points) == len(alone.points)
            # images are looked up in one piece, at places in single precision
            np.testing.assert_allclose(found.points, alone.points, atol=1e-3)
        else:
            assert isinstance(alone, GridPattern)
            np.testing.assert_array_equal(found.values, alone.values)
