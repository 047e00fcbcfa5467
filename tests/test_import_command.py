"""The command ``mixpose import``: what it takes for granted, and files that are not for it."""

from __future__ import annotations

from pathlib import Path

import calibration_texts as texts
import cv2
import numpy as np
import pytest
from command_line import command

from mixpose.cli.importing import gather, session_text
from mixpose.errors import SessionError
from mixpose.session import load_session


def test_the_command_says_what_it_took_for_granted(tmp_path: Path) -> None:
    copied = texts.toml("cam_", names=True)
    copied += copied.split("[metadata]")[0].replace("cam_", "cam_1").replace("view", "again")
    (tmp_path / "calibration.toml").write_text(copied, encoding="utf-8")
    (tmp_path / "marks.csv").write_text("name,x,y,z\na,0,0,0\nb,5,0,0\nc,0,9,0\n", encoding="utf-8")
    (tmp_path / "out").mkdir()
    done = command("import", "calibration.toml", "marks.csv", "-o", "out/s.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    assert "view0 and again0 are the same camera at the same place" in done.stderr
    assert "taken to be in mm, which the file does not say; if not, add --lengths" in done.stderr
    assert "4 cameras (view0, view1, again0, again1), lengths in mm -> out/s.toml" in done.stderr
    session = load_session(tmp_path / "out" / "s.toml")
    assert session.body.name == "marks"
    again = command("import", "calibration.toml", "-o", "out/s.toml", cwd=tmp_path)
    assert again.returncode == 2
    assert "is there already" in again.stderr


def test_a_unit_that_a_format_has_itself_is_not_the_one_that_is_said(tmp_path: Path) -> None:
    (tmp_path / "chain.yaml").write_text(texts.kalibr(), encoding="utf-8")
    warnings = gather([tmp_path / "chain.yaml"], "m", "mm").warnings
    assert "--lengths mm: is not used, as translations of chain.yaml are in m" in warnings[0]
    assert not any(
        "not used" in one for one in gather([tmp_path / "chain.yaml"], "m", None).warnings
    )


def test_lengths_of_a_table_are_those_of_the_session_and_that_is_said(tmp_path: Path) -> None:
    (tmp_path / "chain.yaml").write_text(texts.kalibr(), encoding="utf-8")
    (tmp_path / "marks.csv").write_text("name,x,y,z\na,0,0,0\nb,5,0,0\nc,0,9,0\n", encoding="utf-8")
    files = [tmp_path / "marks.csv", tmp_path / "chain.yaml"]
    taken = "lengths of marks.csv are taken to be in mm, the session's unit"
    plain, other = gather(files, "mm", None), gather(files, "mm", "m")
    assert taken in plain.remarks
    assert not any("marks.csv" in one for one in plain.warnings)
    (told,) = [one for one in other.warnings if "marks.csv" in one]
    assert told == (
        f"--lengths m: is of calibrations; {taken}: write tables in mm, or add --unit m"
    )
    assert f"# {taken}" in session_text(plain, tmp_path / "session.toml")


def test_cameras_of_a_chain_go_by_their_numbers_not_by_their_places(tmp_path: Path) -> None:
    first, step = texts.kalibr().split("cam1:")
    links = {f"cam{n}": f"cam{n}:{step}" for n in range(1, 12)}
    # as YAML's writers sort keys: cam1, cam10, cam11, cam2
    chain = "".join([first, *(links[name] for name in sorted(links))])
    (tmp_path / "chain.yaml").write_text(chain, encoding="utf-8")
    cameras = gather([tmp_path / "chain.yaml"], "m", None).cameras
    assert [camera.name for camera in cameras] == [f"cam{n}" for n in range(12)]
    third = cameras[2].T_camera_rig
    assert third is not None
    two_steps = texts.T_second_first() @ texts.T_second_first()
    np.testing.assert_allclose(third, two_steps, atol=1e-12)


def test_r_and_t_lead_from_the_first_camera_wherever_it_stands(tmp_path: Path) -> None:
    path = tmp_path / "stereo.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    lens, T = np.array([[0.1, 0.01, 0.0, 0.0]]), texts.T_second_first()
    named = {"K_right": texts.K2, "D_right": lens, "K_left": texts.K1, "D_left": lens}
    for name, matrix in {**named, "R": T[:3, :3], "T": T[:3, 3]}.items():
        storage.write(name, matrix)
    storage.release()
    found = gather([path], "m", "m")
    assert [camera.name for camera in found.cameras] == ["left", "right"]
    second = found.cameras[1].T_camera_rig
    assert second is not None
    np.testing.assert_allclose(second, T, atol=1e-12)
    # of a pinhole camera or of a fisheye: nothing in the file says which
    assert any("four coefficients" in warning for warning in found.warnings)


def test_images_of_colmap_may_have_blanks_in_their_names(tmp_path: Path) -> None:
    paths = texts.colmap(tmp_path, with_rig=False)
    named = paths[1].read_text(encoding="utf-8").replace("view/", "my view/")
    paths[1].write_text(named, encoding="utf-8")
    names = [camera.name for camera in gather(paths, "m", "m").cameras]
    assert names == ["my view_0", "my view_1"]


def test_metres_left_in_a_session_in_millimetres_are_doubted(tmp_path: Path) -> None:
    """Three cameras, 0.3 m apart, whose chain was copied without its unit."""
    chain = texts.kalibr()
    chain += chain[chain.index("cam1:") :].replace("cam1:", "cam2:")
    (tmp_path / "chain.yaml").write_text(chain, encoding="utf-8")
    output = tmp_path / "s.toml"
    output.write_text(
        session_text(gather([tmp_path / "chain.yaml"], "m", None), output), encoding="utf-8"
    )
    session = load_session(output)
    text = output.read_text(encoding="utf-8").replace('unit = "m"', 'unit = "mm"')
    lines = text.replace("[0.06, 0.0, 0.0]", "[60, 0, 0]").replace("[0.0, 0.1, 0.0]", "[0, 90, 0]")
    for setup in session.sensors:
        source = f'# source = "{setup.name}/*.png"'
        lines = lines.replace(source, f'source = "{setup.name}.csv"')
        (tmp_path / f"{setup.name}.csv").write_text("frame,u,v\n0,9,9\n", encoding="utf-8")
    output.write_text(lines, encoding="utf-8")
    done = command("check", "s.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "'cam0' and 'cam1' stand 0.32 mm apart" in done.stdout
    assert "are translations in mm?" in done.stdout


def test_an_unknown_unit_of_two_files_names_both(tmp_path: Path) -> None:
    files = texts.stereo_storage(tmp_path, "yml")
    assert len(files) == 2
    (warning, *_) = gather(files, "mm", None).warnings
    assert warning.startswith(f"translations of {files[0].name} and {files[1].name} are taken")


def test_where_cameras_stand_without_their_matrices_is_told(tmp_path: Path) -> None:
    (where,) = [f for f in texts.stereo_storage(tmp_path, "yml") if "M1" not in f.read_text()]
    with pytest.raises(SessionError, match=r"holds R and T, .* no camera matrix; allowed: beside"):
        gather([where], "mm", None)


def test_an_image_is_called_one_and_bodies_are_among_what_is_allowed(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4), np.uint8))
    with pytest.raises(SessionError, match=r"a.png: found an image; allowed: a text file"):
        gather([tmp_path / "a.png"], "mm", None)
    (tmp_path / "n.yml").write_text("a: 1\n", encoding="utf-8")
    with pytest.raises(SessionError, match=r"COLMAP's .*; or a body: .csv, .rom, .vsk, .obj"):
        gather([tmp_path / "n.yml"], "mm", None)


def imported(folder: Path, *bodies: str) -> list[str]:
    """Import files of bodies beside a calibration, and the names that they got."""
    (folder / "chain.yaml").write_text(texts.kalibr(), encoding="utf-8")
    for body in bodies:
        (folder / body).parent.mkdir(exist_ok=True)
        (folder / body).write_text("name,x,y,z\na,0,0,0\nb,5,0,0\nc,0,9,0\n", encoding="utf-8")
    done = command("import", "chain.yaml", *bodies, "-o", "s.toml", cwd=folder)
    assert done.returncode == 0, done.stderr
    return [one.body.name for one in load_session(folder / "s.toml").objects]


def test_bodies_whose_files_are_called_like_numbers_of_others_have_names_of_their_own(
    tmp_path: Path,
) -> None:
    assert imported(tmp_path, "s1/a.csv", "s2/a.csv", "a_1.csv") == ["a", "a_2", "a_1"]


def test_a_session_that_cannot_be_read_again_does_not_block_the_next_try(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(path: Path) -> None:
        raise SessionError(f"{path}: is not as it should be")

    (tmp_path / "chain.yaml").write_text(texts.kalibr(), encoding="utf-8")
    with monkeypatch.context() as patched:
        patched.setattr("mixpose.cli.importing.load_session", refused)
        done = command("import", "chain.yaml", "-o", "s.toml", cwd=tmp_path)
    assert done.returncode == 2
    assert "is not as it should be" in done.stderr
    assert not (tmp_path / "s.toml").exists()
    assert imported(tmp_path, "a.csv") == ["a"]
