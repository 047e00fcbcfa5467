"""Sessions that are wrong: one line that names the file, the key, the find and the rule."""

from __future__ import annotations

from pathlib import Path

import pytest
from session_lines import LINES, message_of, with_lines

from mixpose.session import load_session

LEFT = 'sensor["left"].'
IDENTITY = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"


def test_the_table_itself_is_right(tmp_path: Path) -> None:
    path = tmp_path / "session.toml"
    path.write_text(with_lines(), encoding="utf-8")
    assert len(load_session(path).sensors) == 3


WRONG: list[tuple[dict[str, str], list[str]]] = [
    # the top of the file
    ({"unit": ""}, ["unit: missing", '"m", "cm", "mm", "um"']),
    ({"unit": 'unit = "inch"'}, ['unit: found "inch"', '"cm"']),
    ({"unit": 'unit = "MM"'}, ['did you mean "mm"?']),
    ({"unit": 'unit = "mm"\nsensors = 3'}, ["sensors: unknown key", 'did you mean "sensor"?']),
    ({"object": ""}, ["points: unknown key", "a key of [object]"]),
    ({"unit": 'unit = "mm"\nstart = 3', "start": ""}, ["start: found 3", "[start]"]),
    # keys in the wrong table
    (
        {"unit": 'unit = "mm"\nsigma = 3'},
        ["sigma: unknown key; it is a key of [object] or [object.gravity] or [extract]"],
    ),
    ({"unit": 'unit = "mm"\nfree = ["x"]'}, ["free: unknown key; it is a key of [estimator];"]),
    ({"unit": 'unit = "mm"\nfps = 5'}, ["fps: unknown key; it is a key of [[sensor]];"]),
    ({"extract": "[extract]\nseed = 3"}, ["extract.seed: unknown key", "[estimator]"]),
    (
        {"unit": "", "extract": '[extract]\nunit = "mm"'},
        ["extract.unit: unknown key", "the top of the file, before its first [table]"],
    ),
    # the object
    ({"object": "[object]"}, ["object.name: missing"]),
    ({"object": '[object]\nname = ""'}, ['object.name: found ""']),
    (
        {"object": '[object]\nname = "t"\npionts = 1'},
        ['object.pionts: unknown key; did you mean "points"?'],
    ),
    ({"points": ""}, ["object.points: missing", "markers.csv", "segments"]),
    ({"points": "points = []"}, ["object.points: found []"]),
    ({"points": "points = [[0, 0, 0], [1, 0, 0]]"}, ["object.points: found 2 features", "three"]),
    ({"points": "segments = [[[0, 0, 0], [1, 0, 0]]]"}, ["object.segments: found 1 feature;"]),
    ({"points": "points = [[0, 0, 0], [1, 0]]"}, ["object.points[1]: found [1, 0]", "[x, y, z]"]),
    ({"points": 'points = [[0, 0, 0], [1, 0, "2"]]'}, ['object.points[1][2]: found "2"']),
    ({"points": "points = [[0, nan, 0]]"}, ["object.points[0][1]: found nan", "finite"]),
    ({"points": "points = [[0, true, 0]]"}, ["object.points[0][1]: found true"]),
    ({"points": f"points = [[0, {10**400}, 0]]"}, ["object.points[0][1]", "more digits"]),
    ({"points": LINES["points"] + '\nfile = "m.csv"'}, ["object.file: stands beside points"]),
    ({"points": 'file = "none.csv"'}, ["object.file: no such file", "none.csv"]),
    ({"points": "segments = [[[0, 0, 0], [1, 0]]]"}, ["object.segments[0][1]: found [1, 0]"]),
    (
        {"sigma": "segments = [[[1, 2, 3], [1, 2, 3]]]"},
        ["object.segments[0]: found a segment without length"],
    ),
    # time
    ({"left": LINES["left"] + '\ndelay = "late"'}, ["delay", 'found "late"', '"estimate"']),
    ({"left": LINES["left"] + "\ndelay = 6"}, ["delay: found 6", "from -1 to 1"]),
    ({"left": LINES["left"] + "\nreadout = -0.1"}, ["readout: found -0.1", "from 0 to 1"]),
    ({"left": LINES["left"] + "\nexposure = 2"}, ["exposure: found 2", "from 0 to 1"]),
    ({"left": LINES["left"] + "\nreadout = 0.02"}, ["readout: stands without resolution"]),
    # markers with a size
    ({"points": LINES["points"] + '\nshape = "ball"'}, ['object.shape: found "ball"', '"sphere"']),
    (
        {"points": LINES["points"] + '\nshape = "sphere"'},
        ["object.radius: missing", "greater than 0"],
    ),
    ({"points": LINES["points"] + "\nradius = 5"}, ["object.radius: stands beside shape"]),
    (
        {"points": LINES["points"] + '\nshape = "sphere"\nradius = [5, 5]'},
        ["object.radius: found 2 radii for 4 points"],
    ),
    (
        {"points": LINES["points"] + '\nshape = "sphere"\nradius = [5, 5, 0, 5]'},
        ["object.radius: found 0; allowed"],
    ),
    (
        {"points": LINES["points"] + '\nshape = "sphere"\nradius = "big"'},
        ["object.radius", 'found "big"'],
    ),
    ({"normals": 'shape = "disk"\nradius = 3'}, ["object.normals: missing", "normal of each disk"]),
    ({"normals": "normals = [[0, 0, 1]]"}, ["object.normals: found 1 normals for 4 features"]),
    (
        {"normals": "normals = [[0, 0, 1], [0, 0, 1], [0, 0, 0], [0, 0, 1]]"},
        ["object.normals[2]: found a normal of length 0"],
    ),
    # sigma
    ({"sigma": "sigma = -1"}, ["object.sigma: found -1", "at least 0"]),
    ({"sigma": "sigma = [1, -2, 1]"}, ["object.sigma: found -2"]),
    ({"sigma": "sigma = inf"}, ["object.sigma: found inf"]),
    ({"sigma": "sigma = 1e200"}, ["object.sigma: found 1e+200"]),
    ({"sigma": 'sigma = "5"'}, ['object.sigma: found "5"', "[sx, sy, sz]"]),
    ({"sigma": "sigma = []"}, ["object.sigma: found []"]),
    ({"sigma": "sigma = [1, 2]"}, ["object.sigma: found 2 items for 4 features"]),
    ({"sigma": "sigma = [1, 2, 3, -4]"}, ["object.sigma[3]: found -4"]),
    ({"sigma": "sigma = [1, 2, 3, [1, nan, 1]]"}, ["object.sigma[3][1]: found nan"]),
    ({"sigma": "sigma = [1, 2, 3, {a = 1}]"}, ["object.sigma[3]: found {a = 1}"]),
    (
        {"sigma": "sigma = [[1, 2, 0], [0, 1, 0], [0, 0, 1]]"},
        ["object.sigma: found a matrix that is not symmetric"],
    ),
    (
        {"sigma": "sigma = [[1, 2, 0], [2, 1, 0], [0, 0, 1]]"},
        ["object.sigma: found a matrix with the eigenvalue -1"],
    ),
    (
        {
            "points": "points = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]",
            "sigma": "sigma = [[2, 2, 2], [2, 2, 2], [2, 2, 2]]",
        },
        ["object.sigma:", "may be a covariance or one", "write sigma = 2"],
    ),
    # start
    ({"start": "[start]"}, ["start.T_world_object: missing", "quaternion_xyzw"]),
    ({"start": "[start]\nrotation_vector = [0, 0, 0]"}, ["start.translation: missing"]),
    (
        {"start": "[start]\nrotation_vector = [0, 0, 45]\ntranslation = [0, 0, 0]"},  # in degrees
        ["start.rotation_vector: found an angle of 45 radians", "at most a full turn"],
    ),
    (
        {"start": "[start]\ntranslation = [0, 0, 0]"},
        ["start.translation: stands without a rotation", "euler_xyz_deg"],
    ),
    (
        {"start": f"[start]\nT_world_object = {IDENTITY}\neuler_xyz_deg = [0, 0, 0]"},
        ["start.euler_xyz_deg: stands beside T_world_object"],
    ),
    (
        {"start": f"[start]\nT_world_object = {IDENTITY}\ntranslation = [0, 0, 0]"},
        ["start.translation: stands beside T_world_object"],
    ),
    (
        {"start": "[start]\nT_world_object = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]"},
        ["start.T_world_object: found [[1, 0, 0]", "4x4"],
    ),
    (
        {"start": "[start]\nquaternion_xyzw = [0, 0, 0, 2]\ntranslation = [0, 0, 0]"},
        ["start.quaternion_xyzw: found a quaternion of length 2"],
    ),
    (
        {"start": "[start]\nquaternion_xyzw = [0, 0, 0, 0]\ntranslation = [0, 0, 0]"},
        ["start.quaternion_xyzw: found a quaternion of length 0"],
    ),
    ({"start": LINES["start"] + "\nrotation_deg = 0"}, ["start.rotation_deg: found 0"]),
    ({"start": LINES["start"] + "\nrotation_deg = 181"}, ["start.rotation_deg: found 181", "180"]),
    ({"start": LINES["start"] + "\ndistance = -2"}, ["start.distance: found -2"]),
    ({"start": LINES["start"] + "\ndistance = inf"}, ["start.distance: found inf"]),
    # estimator
    ({"estimator": '[estimator]\nobjective = "match"'}, ["estimator.objective", '"matched"?']),
    ({"estimator": "[estimator]\nfree = []"}, ["estimator.free: found []"]),
    (
        {"estimator": "[estimator]\nconfidence = 99.9"},
        ["estimator.confidence: found 99.9", "at least 0.5, below 1"],
    ),
    (
        {"left": '[[camera]]\nname = "left"\nmodel = "pinhole"\nsource = "l*.png"'},
        ["camera: unknown key", "did you mean [[sensor]]?"],
    ),
    ({"estimator": '[estimator]\nfree = "x"'}, ['estimator.free: found "x"', "a list"]),
    ({"estimator": '[estimator]\nfree = ["x", "w"]'}, ['estimator.free[1]: found "w"', '"rx"']),
    ({"estimator": '[estimator]\nfree = ["x", "x"]'}, ["estimator.free", '"x" stands there twice']),
    ({"estimator": '[estimator]\nfree = [["x"]]'}, ['estimator.free[0]: found ["x"]']),
    (
        {"start": "", "estimator": '[estimator]\nfree = ["x", "y", "z", "rx"]'},
        ['estimator.free: leaves out "ry", "rz"', "held", "there is no [start]"],
    ),
    ({"estimator": "[estimator]\nsamples = 0"}, ["estimator.samples: found 0", "at least 2"]),
    ({"estimator": "[estimator]\nsamples = 1.5"}, ["estimator.samples: found 1.5", "an integer"]),
    ({"estimator": "[estimator]\nseed = -1"}, ["estimator.seed: found -1"]),
    ({"estimator": "[estimator]\nseed = true"}, ["estimator.seed: found true"]),
    # extract
    ({"extract": '[extract]\nmethod = "blob"'}, ["extract.method", 'did you mean "blobs"?']),
    (
        {"extract": '[extract]\nmethod = "a:b:c"'},
        ['extract.method: found "a:b:c"', "module:function"],
    ),
    ({"extract": '[extract]\npolarity = "drak"'}, ["extract.polarity", 'did you mean "dark"?']),
    (
        {"extract": '[extract]\nthreshold = "outs"'},
        ["extract.threshold", '"local", "li", "triangle", "sauvola" or a grey level', '"otsu"?'],
    ),
    ({"extract": "[extract]\nthreshold = nan"}, ["extract.threshold: found nan"]),
    ({"extract": "[extract]\nthreshold = true"}, ["extract.threshold: found true"]),
    ({"extract": "[extract]\nsigma = 0"}, ["extract.sigma: found 0", "greater than 0"]),
    ({"extract": "[extract]\nmin_area = -1"}, ["extract.min_area: found -1"]),
    ({"extract": "[extract]\nmax_area = 2"}, ["extract.max_area: found 2", "min_area, which is 3"]),
    (
        {"extract": "[extract]\ntreshold = 3"},
        ['extract.treshold: unknown key; did you mean "threshold"?'],
    ),
    (
        {"extract": "[extract]\nmax_area = 10", "left_more": "[sensor.extract]\nmin_area = 10"},
        [LEFT + "extract.max_area: found 10", "min_area, which is 10"],
    ),
    (
        {"left_more": "[sensor.extract]\nsigam = 3"},
        [LEFT + 'extract.sigam: unknown key; did you mean "sigma"?'],
    ),
    # finite, but beyond what can be reckoned with
    (
        {"extract": "[extract]\nsigma = 1e-300"},
        ["extract.sigma: found 1e-300", "greater than 0", "the smallest is 1e-12"],
    ),
    (
        {"extract": "[extract]\nsigma = 1e99"},
        ["extract.sigma: found 1e+99", "the largest number is 1e+12"],
    ),
    ({"extract": "[extract]\nsigma = 5000"}, ["extract.sigma: found 5000", "at most 1000 px"]),
    (
        {"extract": "[extract]\nspot_sigma = 5000"},
        ["extract.spot_sigma: found 5000", "at most 1000 px"],
    ),
    (
        {"sonar_keys": "position = [0, 1e99, 0]"},
        ['sensor["sonar"].position[1]: found 1e+99', "the largest number is 1e+12"],
    ),
    (
        {"sonar_keys": "position = [1, 2, 3]\nrange_min = 1\nbin_size = 1e-7"},
        ['sensor["sonar"].extract.sigma: found 1.5', "at most 100000 times bin_size"],
    ),
    (
        {"sonar_keys": "position = [1, 2, 3]\nrange_min = 1\nbin_size = 1e5"},
        ['sensor["sonar"].extract.sigma: found 1.5 with bin_size = 100000', "a 1000th of bin_size"],
    ),
    (
        {"estimator": "[estimator]\nsamples = 100000000000"},
        ["estimator.samples: found 100000000000", "at most 1000000"],
    ),
    (
        {"points": "points = [[0, 0, 0], [0, 0, 0], [50, 0, 0], [50, 0, 0]]"},
        ["object.points: found 4 features at 2 places", "at least three"],
    ),
]


MORE_WRONG: list[tuple[dict[str, str], list[str]]] = [
    (
        {"points": "points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]]"},
        ["object.points: point 4 is where point 2 is, alike in all", "each point once"],
    ),
    (
        {"normals": "gravity = { direction = [0, 0, 0], sigma = 1 }"},
        ["object.gravity.direction: found a direction without length"],
    ),
    (
        {"left_more": "calibration_error = { range_bias = 1 }"},
        [LEFT + "calibration_error.range_bias: stands with", "pinhole", "all but range_bias"],
    ),
    (
        {"sonar_keys": LINES["sonar keys"] + "\ncalibration_error = { focal = 0.1 }"},
        ["calibration_error.focal: stands with", "lateration", "allowed: position, range_bias"],
    ),
    (
        {"left_more": "resolution = [100000, 100000]"},
        [LEFT + "resolution: found 100000 x 100000 pixels; allowed: at most"],
    ),
    (
        {"matrix": "camera_matrix = [[800, 0, 0], [0, 800, 0], [640, 512, 1]]"},
        [LEFT + "camera_matrix: found", "; transpose it"],
    ),
    (
        {"matrix": "camera_matrix = [[800, 0, 640], [5, 800, 512], [0, 0, 1]]"},
        [LEFT + "camera_matrix: found", "512.0], [0.0, 0.0, 1.0]]; allowed"],
    ),
    ({"normals": 'names = ["a", "b"]'}, ["object.names: found 2 names for 4 points; allowed: one"]),
    (
        {"normals": 'names = ["a", "b", "c", " a"]'},
        ["object.names[3]: found", "allowed: a name of its own for each point"],
    ),
    (
        {"points": 'file = "m.csv"', "normals": 'names = ["a", "b", "c"]'},
        ["object.names: stands beside file, which has names; allowed: one of the two"],
    ),
]


@pytest.mark.parametrize(("changed", "words"), MORE_WRONG)
def test_what_can_be_read_and_cannot_be_meant_is_told(
    tmp_path: Path, changed: dict[str, str], words: list[str]
) -> None:
    (tmp_path / "m.csv").write_text("name,x,y,z\na,0,0,0\nb,10,0,0\nc,0,20,0\n")
    message = message_of(tmp_path, with_lines(**changed))
    for word in words:
        assert word in message


@pytest.mark.parametrize(("changed", "words"), WRONG, ids=lambda case: str(case)[:70])
def test_a_wrong_line_is_named(tmp_path: Path, changed: dict[str, str], words: list[str]) -> None:
    message = message_of(tmp_path, with_lines(**changed))
    for word in words:
        assert word in message


def test_further_findings_are_counted(tmp_path: Path) -> None:
    message = message_of(tmp_path, with_lines(unit='unit = "x"', extract="[extract]\nsigma = 0"))
    assert message.startswith("unit: ")
    assert message.endswith("(and 1 more)")


def test_an_unknown_key_comes_before_what_is_missing_for_it(tmp_path: Path) -> None:
    message = message_of(tmp_path, with_lines(unit='unti = "mm"'))
    assert message.startswith('unti: unknown key; did you mean "unit"?')
