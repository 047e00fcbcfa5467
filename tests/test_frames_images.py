"""Image sources: order, numbers, depth, and files that are not whole."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from mixpose.errors import RecordingError, SessionError
from mixpose.frames import Source, SourceSpec, open_source, read_image
from mixpose.frames.images import frame_numbers, natural_order

PICTURE = np.random.default_rng(1).integers(0, 256, (24, 32), dtype=np.uint8)


def save(folder: Path, *names: str, image: np.ndarray = PICTURE) -> None:
    for name in names:
        assert cv2.imwrite(str(folder / name), image)


def camera(base: Path, source: str | tuple[str, ...], **options: object) -> Source:
    return open_source(SourceSpec("left", source, base, "camera", **options))  # type: ignore[arg-type]


def numbers(source: Source, *selection: int | None) -> list[int]:
    return [frame.number for frame in source.frames(*selection)]  # type: ignore[arg-type]


def test_numbers_at_the_end_of_names_are_the_frame_numbers() -> None:
    assert frame_numbers([Path("cam2_007.png"), Path("cam2_12.png")]) == [7, 12]
    assert frame_numbers([Path("shot-3.png"), Path("a.4.png")]) == [3, 4]


def test_numbers_go_by_place_where_one_name_ends_in_none() -> None:
    assert frame_numbers([Path("a5.png"), Path("b.png"), Path("c9.png")]) == [0, 1, 2]


def test_numbers_go_by_place_where_two_are_alike() -> None:
    assert frame_numbers([Path("x/a5.png"), Path("y/a05.png")]) == [0, 1]


def test_one_file_among_numbered_ones_that_takes_their_numbers_is_named(tmp_path: Path) -> None:
    save(tmp_path, "a5.png", "a6.png", "b.png")
    assert str(camera(tmp_path, "*.png").caution()) == (
        "b.png ends in no frame number but 2 others do, so all are numbered by their place; "
        "leave it out of the source"
    )
    # two files are too few to tell which is the odd one
    assert camera(tmp_path, ("a5.png", "b.png")).caution() is None


def test_two_names_of_one_number_are_told(tmp_path: Path) -> None:
    save(tmp_path, "a5.png", "a6.png", "b05.png")
    assert "two names end in the frame number 5" in str(camera(tmp_path, "*.png").caution())


def test_natural_order_counts_inside_names() -> None:
    paths = [Path(name) for name in ("img10.png", "img9.png", "img1a.png", "Img2.png", "img.png")]
    ordered = [path.name for path in natural_order(paths)]
    assert ordered == ["Img2.png", "img.png", "img1a.png", "img9.png", "img10.png"]


def test_glob_yields_frames_by_ascending_number(tmp_path: Path) -> None:
    save(tmp_path, "b10_2.png", "b9_3.png", "other.png")
    source = camera(tmp_path, "b*.png")
    assert numbers(source) == [2, 3]
    assert source.first == 2
    assert source.length == 2


def test_glob_leaves_out_what_is_no_image(tmp_path: Path) -> None:
    save(tmp_path, "left01.png", "left02.PNG")
    (tmp_path / "left.yml").write_text("calibration")
    assert numbers(camera(tmp_path, "left*")) == [1, 2]


def test_absolute_glob_ignores_the_base(tmp_path: Path) -> None:
    save(tmp_path, "a1.png")
    assert numbers(camera(Path("/nowhere"), str(tmp_path / "a*.png"))) == [1]


def test_brackets_in_a_folder_name_are_no_pattern(tmp_path: Path) -> None:
    folder = tmp_path / "take [1]"
    folder.mkdir()
    save(folder, "a1.png", "a2.png")
    assert numbers(camera(folder, "a*.png")) == [1, 2]
    assert numbers(camera(tmp_path, "take [1]")) == [1, 2]


def test_list_keeps_its_own_order_where_numbers_go_by_place(tmp_path: Path) -> None:
    save(tmp_path, "z.png")
    save(tmp_path, "a.png", image=PICTURE + 1)
    frames = list(camera(tmp_path, ("z.png", "a.png")).frames())
    assert [frame.number for frame in frames] == [0, 1]
    np.testing.assert_array_equal(frames[0].data, PICTURE)


def test_folder_reads_its_images_only(tmp_path: Path) -> None:
    save(tmp_path, "f3.png", "f20.png", "._f4.png")
    (tmp_path / "notes.txt").write_text("hello")
    source = camera(tmp_path.parent, tmp_path.name)
    assert numbers(source) == [3, 20]
    assert source.describe() == "2 images 32x24, frames 3-20 with gaps"


def test_selection_counts_frame_numbers_like_range(tmp_path: Path) -> None:
    save(tmp_path, *(f"f{n}.png" for n in (3, 4, 5, 6, 8, 9)))
    source = camera(tmp_path, "f*.png")
    assert numbers(source, None, None, 2) == [3, 5, 9]
    assert numbers(source, 4, 9, 2) == [4, 6, 8]
    assert numbers(source, 100) == []
    with pytest.raises(SessionError, match="step"):
        numbers(source, None, None, 0)


def test_skipped_images_are_not_opened(tmp_path: Path) -> None:
    save(tmp_path, "f0.png", "f2.png")
    (tmp_path / "f1.png").write_bytes(b"no image")
    assert numbers(camera(tmp_path, "f*.png"), 0, None, 2) == [0, 2]


def test_sixteen_bits_are_kept(tmp_path: Path) -> None:
    deep = PICTURE.astype(np.uint16) * 250
    save(tmp_path, "deep.png", image=deep)
    source = camera(tmp_path, "deep.png")
    (frame,) = source.frames()
    assert isinstance(frame.data, np.ndarray)
    assert frame.data.dtype == np.uint16
    np.testing.assert_array_equal(frame.data, deep)
    assert source.describe() == "1 image 32x24 uint16, frame 0"


def test_colour_becomes_grey(tmp_path: Path) -> None:
    save(tmp_path, "c.png", image=np.dstack([PICTURE] * 3))
    np.testing.assert_array_equal(read_image(tmp_path / "c.png"), PICTURE)


def test_file_names_longer_than_64_bits_count(tmp_path: Path) -> None:
    save(tmp_path, "t20240131120000123456.png", "t20240131120000123457.png")
    assert numbers(camera(tmp_path, "t*.png"))[-1] == 20240131120000123457


def test_size_must_be_the_resolution(tmp_path: Path) -> None:
    save(tmp_path, "f1.png")
    with pytest.raises(RecordingError, match=r"f1\.png: found 32x24 .* 640x480"):
        numbers(camera(tmp_path, "f*.png", resolution=(640, 480)))
    assert numbers(camera(tmp_path, "f*.png", resolution=(32, 24))) == [1]


def test_size_must_be_that_of_the_first_image(tmp_path: Path) -> None:
    save(tmp_path, "f1.png", "f2.png")
    save(tmp_path, "f3.png", image=PICTURE[:-1])
    stream = camera(tmp_path, "f*.png").frames()
    assert [next(stream).number, next(stream).number] == [1, 2]
    with pytest.raises(RecordingError, match=r"f3\.png: found 32x23 .* 32x24 like f1\.png"):
        next(stream)


def test_a_tiff_file_of_several_images_is_refused_and_one_with_a_thumbnail_is_read(
    tmp_path: Path,
) -> None:
    image = np.arange(48, dtype=np.uint8).reshape(6, 8)
    tifffile.imwrite(tmp_path / "three.tif", np.stack([image] * 3), photometric="minisblack")
    with pytest.raises(RecordingError, match=r"three\.tif: holds 3 images; allowed is one image"):
        read_image(tmp_path / "three.tif")
    with tifffile.TiffWriter(tmp_path / "small.tif") as file:
        file.write(image)
        file.write(image[::2, ::2], subfiletype=1)
    assert np.array_equal(read_image(tmp_path / "small.tif"), image)
    (tmp_path / "cut.tif").write_bytes((tmp_path / "three.tif").read_bytes()[:6])
    with pytest.raises(RecordingError, match=r"cut\.tif: "):
        read_image(tmp_path / "cut.tif")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".pgm", ".tif", ".webp"])
@pytest.mark.parametrize("kept", [0.05, 0.5, 0.97])
def test_truncated_image_is_told(tmp_path: Path, suffix: str, kept: float) -> None:
    path = tmp_path / f"f1{suffix}"
    large = np.random.default_rng(0).integers(0, 256, (80, 90), dtype=np.uint8)
    save(tmp_path, path.name, image=large)
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(RecordingError, match=path.name):
        read_image(path)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_bytes_behind_the_end_are_harmless(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"f1{suffix}"
    save(tmp_path, path.name)
    whole = read_image(path)
    path.write_bytes(path.read_bytes() + b"\0garbage" * 40)
    np.testing.assert_array_equal(read_image(path), whole)


def test_truncated_jpeg_is_told_in_spite_of_the_end_of_its_preview(tmp_path: Path) -> None:
    data = cv2.imencode(".jpg", np.kron(PICTURE, np.ones((4, 4), np.uint8)))[1].tobytes()
    preview = cv2.imencode(".jpg", PICTURE)[1].tobytes()
    segment = b"\xff\xe1" + (len(preview) + 2).to_bytes(2) + preview
    path = tmp_path / "f1.jpg"
    path.write_bytes(data[:2] + segment + data[2:])
    assert read_image(path).shape == (96, 128)
    path.write_bytes(data[:2] + segment + data[2:-200])
    with pytest.raises(RecordingError, match=r"f1\.jpg: cut short"):
        read_image(path)


def test_bytes_that_fill_up_between_segments_of_a_jpeg_are_no_segment(tmp_path: Path) -> None:
    data = cv2.imencode(".jpg", PICTURE)[1].tobytes()
    path = tmp_path / "f1.jpg"
    path.write_bytes(data[:2] + b"\xff\xff" + data[2:])
    np.testing.assert_array_equal(read_image(path), cv2.imdecode(np.frombuffer(data, np.uint8), 0))


def test_wrong_byte_in_a_png_is_told_by_its_checksum(tmp_path: Path) -> None:
    path = tmp_path / "f1.png"
    save(tmp_path, path.name)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=r"f1\.png: damaged: the checksum"):
        read_image(path)


@pytest.mark.parametrize("content", [b"", b"text, not an image", b"\xff\xd8\xff"])
def test_file_that_is_no_image_is_told(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "f1.png"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"f1\.png: "):
        read_image(path)


def test_nan_in_a_float_image_is_told(tmp_path: Path) -> None:
    image = PICTURE.astype(np.float32)
    image[3, 4] = np.nan
    save(tmp_path, "f1.tif", image=image)
    with pytest.raises(RecordingError, match=r"f1\.tif: .*not finite"):
        read_image(tmp_path / "f1.tif")


def test_rate_gives_times(tmp_path: Path) -> None:
    save(tmp_path, "f10.png", "f12.png")
    times = [frame.time_s for frame in camera(tmp_path, "f*.png", fps=20.0).frames()]
    assert times == [0.5, 0.6]
