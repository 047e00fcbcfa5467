"""Mutants of what reads recordings: `frames`."""

from __future__ import annotations

from mutation.mutant import Mutant

_PAIRING = (
    Mutant(
        "frames-may-go-back-in-time",
        "frames/pairing.py",
        "time_s < last[sensor]:",
        "time_s < -math.inf:",
        "a table of times that goes back ends in a traceback",
        ("test_frames_pairing.py",),
    ),
    Mutant(
        "frames-pair-the-latest",
        "frames/pairing.py",
        "number = min(waiting)",
        "number = max(waiting)",
        "frames that one sensor lacks are lost for all",
    ),
    Mutant(
        "frames-time-of-the-last-sensor",
        "frames/pairing.py",
        "for frame in frames.values() if frame.time_s is not None",
        "for frame in [*frames.values()][::-1] if frame.time_s is not None",
        "times of poses are those of another sensor",
    ),
    Mutant(
        "frames-begin-with-the-last-sensor",
        "frames/pairing.py",
        "first = min((number",
        "first = max((number",
        "the first frames of a sensor that began earlier are skipped",
    ),
    Mutant(
        "frames-pair-reads-one-ahead",
        "frames/pairing.py",
        "            yield FrameSet(number, next(times, None), frames)\n"
        "            for sensor in frames:\n"
        "                heads[sensor] = next(streams[sensor], None)\n",
        "            for sensor in frames:\n"
        "                heads[sensor] = next(streams[sensor], None)\n"
        "            yield FrameSet(number, next(times, None), frames)\n",
        "a pose waits for the frame after it, and a damaged frame costs the one before it",
    ),
)

_NUMBERS = (
    Mutant(
        "frames-selection-from-zero",
        "frames/source.py",
        "start = first or 0",
        "start = 0",
        "--step counts from 0 where the recording does not",
    ),
    Mutant(
        "frames-twins-keep-their-number",
        "frames/images.py",
        "if len(numbers) == len({*numbers}) == len(paths) else",
        "if len(numbers) == len(paths) else",
        "two images of one number are frames twice",
    ),
    Mutant(
        "frames-order-by-letters",
        "frames/images.py",
        "return [int(p) if i % 2 else p for i, p in enumerate(pieces)], str(path)",
        "return [p for p in pieces], str(path)",
        "img10 comes before img9",
    ),
    Mutant(
        "frames-skipped-images-are-opened",
        "frames/images.py",
        "            if number not in wanted:\n"
        "                continue\n"
        "            image = read_image(path)\n",
        "            image = read_image(path)\n"
        "            if number not in wanted:\n"
        "                continue\n",
        "a damaged image ends a run that was told to skip it",
    ),
    Mutant(
        "frames-images-of-eight-bits",
        "frames/images.py",
        "cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH",
        "cv2.IMREAD_GRAYSCALE",
        "images of 16 bits lose all but their highest 8",
    ),
    Mutant(
        "frames-images-of-any-size",
        "frames/images.py",
        "if _size(image) != size:",
        "if _size(image) > size:",
        "images of a binned or cropped recording pass with the wrong calibration",
    ),
    Mutant(
        "frames-table-out-of-order",
        "frames/tables.py",
        "in_order = last is None or key >= last",
        "in_order = True",
        "the rows of one frame become several frames",
    ),
    Mutant(
        "frames-video-counts-what-it-gives",
        "frames/video.py",
        "                        yield frame\n                number += 1\n",
        "                        yield frame\n                    number += 1\n",
        "frames of a video are misnumbered after the first that is skipped",
    ),
)

_VALUES = (
    Mutant(
        "frames-rate-multiplies",
        "frames/times.py",
        "lambda number: number / fps",
        "lambda number: number * fps",
        "times are those of the period in place of the rate",
    ),
    Mutant(
        "frames-time-of-the-latest-detection",
        "frames/tables.py",
        "float(seconds.min())",
        "float(seconds.max())",
        "the time of a frame is that of its last row",
    ),
    Mutant(
        "frames-a-time-twice-passes",
        "frames/times.py",
        "if number in times:",
        "if False:",
        "a table of times that contradicts itself is taken",
    ),
    Mutant(
        "frames-weight-zero-is-a-detection",
        "frames/tables.py",
        "points[weights > 0], weights[weights > 0]",
        "points[weights >= 0], weights[weights >= 0]",
        "a frame without features has one at (0, 0)",
    ),
    Mutant(
        "frames-columns-in-file-order",
        "frames/tables.py",
        "[self.columns.index(name) for name in self.coordinates]",
        "[i for i, name in enumerate(self.columns) if name in self.coordinates]",
        "u and v change places where the table has v first",
    ),
    Mutant(
        "frames-bins-begin-at-their-edge",
        "frames/profiles.py",
        "np.array([self.range_min])",
        "np.array([self.range_min + 0.5 * self.bin_size])",
        "ranges are off by half a bin",
    ),
    Mutant(
        "frames-video-in-milliseconds",
        "frames/video.py",
        "time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000",
        "time_s = capture.get(cv2.CAP_PROP_POS_MSEC)",
        "times of a video are a thousand times too large",
    ),
    Mutant(
        "frames-colour-is-its-blue",
        "frames/capture.py",
        "cv2.cvtColor(image, code, np.empty(image.shape[:2], image.dtype))",
        "image[:, :, 0].copy()",
        "a red feature of a colour video is black",
    ),
)

MUTANTS = (*_PAIRING, *_NUMBERS, *_VALUES)
