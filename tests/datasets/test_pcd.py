"""Clouds in the three encodings of PCD, with the intensity in either place, and what broken files say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pypcd4.pypcd4 import Encoding, PointCloud

from cobevglue.datasets import read_pcd
from cobevglue.datasets.pcd import read_bin, write_pcd_rgb

POINTS = np.array([[1.5, -2.25, 0.125], [-30.0, 4.0, -1.75], [100.0, 0.0, 2.0]], dtype=np.float32)
RED = np.array([0, 127, 255], dtype=np.uint32)
ENCODINGS = [Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED]


def save(path: Path, encoding: Encoding, fourth: str, values: np.ndarray) -> Path:
    columns = [*POINTS.T, values]
    types = [np.float32] * 3 + [values.dtype]
    PointCloud.from_points(columns, ("x", "y", "z", fourth), types).save(path, encoding=encoding)
    return path


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_field_intensity_is_scaled(tmp_path: Path, encoding: Encoding) -> None:
    path = save(tmp_path / "a.pcd", encoding, "intensity", np.array([0, 51, 300], dtype=np.float32))
    points = read_pcd(path, intensity_scale=1 / 255)
    np.testing.assert_array_equal(points[:, :3], POINTS)
    np.testing.assert_allclose(points[:, 3], [0, 0.2, 1.0], rtol=1e-6)  # what is beyond the scale is cut
    assert points.dtype == np.float32


@pytest.mark.parametrize("encoding", ENCODINGS[1:])
@pytest.mark.parametrize("kind", [np.float32, np.uint32])
def test_the_red_byte_of_rgb_is_the_intensity(tmp_path: Path, encoding: Encoding, kind: type) -> None:
    packed = (RED << 16) | (17 << 8) | 200  # green and blue must not matter
    path = save(tmp_path / "a.pcd", encoding, "rgb", packed.view(kind))
    np.testing.assert_allclose(read_pcd(path)[:, 3], RED / 255, rtol=1e-6)


def ascii_file(path: Path, rows: str, points: int, fields: str = "x y z rgb") -> Path:
    n = len(fields.split())
    path.write_text(
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\nSIZE {' '.join('4' * n)}\n"
        f"TYPE {' '.join('F' * n)}\nCOUNT {' '.join('1' * n)}\nWIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {points}\nDATA ascii\n{rows}"
    )
    return path


def test_ascii_rgb_denormal_floats_give_intensity(tmp_path: Path) -> None:
    red = np.array([3, 100, 160, 255], dtype=np.uint32)  # below 128 the packed colour is a denormal float
    rows = "".join(f"{i} 0 0 {value:.10g}\n" for i, value in enumerate((red << 16).view(np.float32).tolist()))
    np.testing.assert_allclose(read_pcd(ascii_file(tmp_path / "a.pcd", rows, 4))[:, 3], red / 255, rtol=1e-6)


@pytest.mark.parametrize(
    ("rows", "points", "fields", "expected", "why"),
    [
        ("1 2 3 0\n", 1, "x y z rgb", [[1, 2, 3, 0]], "a single point is still a row"),
        ("", 0, "x y z rgb", np.zeros((0, 4)), "an empty cloud has no points and is no error"),
        ("1 2 3 0\nnan nan nan 0\n", 2, "x y z rgb", [[1, 2, 3, 0]], "a beam without return is left out"),
        ("1 2 3\n", 1, "x y z", [[1, 2, 3, 0]], "without colour the intensity is 0"),
        ("9 3 2 1\n", 1, "ring z y x", [[1, 2, 3, 0]], "fields are found by name"),
    ],
)
def test_small_files(
    tmp_path: Path, rows: str, points: int, fields: str, expected: list[list[float]], why: str
) -> None:
    np.testing.assert_array_equal(read_pcd(ascii_file(tmp_path / "a.pcd", rows, points, fields)), expected, why)


def test_left_handed_files_are_mirrored(tmp_path: Path) -> None:
    path = save(tmp_path / "a.pcd", Encoding.BINARY, "rgb", RED)
    np.testing.assert_array_equal(read_pcd(path, left_handed=True)[:, :3], POINTS * [1, -1, 1])


@settings(max_examples=25, deadline=None)
@given(
    st.lists(
        st.tuples(*[st.floats(-200, 200, width=32)] * 3, st.integers(0, 255).map(lambda red: red / 255)), max_size=20
    )
)
def test_points_survive_writing_and_reading_exactly(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float, ...]]
) -> None:
    points = np.array(rows, dtype=np.float32).reshape(-1, 4)
    path = tmp_path_factory.mktemp("pcd") / "a.pcd"
    write_pcd_rgb(path, points)
    np.testing.assert_array_equal(read_pcd(path, left_handed=True), points)


@pytest.mark.parametrize(
    ("points", "message"),
    [(np.zeros((2, 3)), "shape"), ([[0, 0, np.nan, 0]], "finite"), ([[0, 0, 0, 1.5]], r"\[0, 1\]")],
)
def test_writer_refuses_unsupported_points(tmp_path: Path, points: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write_pcd_rgb(tmp_path / "a.pcd", points)


def good_bytes(path: Path, encoding: Encoding) -> bytes:
    return save(path, encoding, "rgb", RED.view(np.float32)).read_bytes()


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("kept", [0.0, 0.5, 0.93])
def test_truncated_file_is_named(tmp_path: Path, encoding: Encoding, kept: float) -> None:
    path = tmp_path / "000069.pcd"
    content = good_bytes(path, encoding)
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(ValueError, match=r"000069\.pcd") as error:
        read_pcd(path)
    assert "\n" not in str(error.value)


def test_a_point_missing_at_the_end_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.pcd"
    path.write_bytes(good_bytes(path, Encoding.BINARY)[:-16])
    with pytest.raises(ValueError, match="states 3 points, the file has 2"):
        read_pcd(path)


@pytest.mark.parametrize("content", [b"", b"\x00\xff\xfe" * 100, b"hello\nworld\n"])
def test_something_else_under_that_name_is_an_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.pcd").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.pcd"):
        read_pcd(tmp_path / "a.pcd")


def test_a_file_without_coordinates_names_the_field(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"a\.pcd: no field 'z'"):
        read_pcd(ascii_file(tmp_path / "a.pcd", "1 2 3\n", 1, "x y rgb"))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"a\.pcd"):
        read_pcd(tmp_path / "a.pcd")


def test_ascii_and_binary_clouds_agree(culver_city: Path) -> None:
    """The binary one was recovered from a crop; every point of it is one of the ASCII file, with its intensity."""
    ascii_points = read_pcd(culver_city / "raw_ascii_sample.pcd", left_handed=True)
    binary = read_pcd(culver_city / "test_culvercity" / "TwoCars_1" / "car1" / "006226.pcd", left_handed=True)
    assert len(ascii_points) == 57689
    assert 0.0 < ascii_points[:, 3].min() < ascii_points[:, 3].max() <= 1.0
    known = {tuple(row) for row in np.round(ascii_points * [100, 100, 100, 255]).astype(int)}
    found = [tuple(row) in known for row in np.round(binary * [100, 100, 100, 255]).astype(int)]
    assert np.mean(found) > 0.97


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    ("count", "fields"),
    [
        (None, "x y z intensity"),  # COUNT is left out: one of each
        ("1 1 1 1", "x y z intensity"),
        ("1 1 0 1 1", "x y normal z intensity"),  # a field of COUNT 0 holds no data
    ],
)
def test_fields_with_count_zero_or_none(tmp_path: Path, encoding: Encoding, count: str | None, fields: str) -> None:
    path = save(tmp_path / "a.pcd", encoding, "intensity", np.array([0.0, 0.5, 1.0], dtype=np.float32))
    header, data = path.read_bytes().split(b"DATA", 1)
    n = len(fields.split())
    kept = [
        line for line in header.split(b"\n") if line.split()[:1] not in ([b"FIELDS"], [b"SIZE"], [b"TYPE"], [b"COUNT"])
    ]
    kept += [f"FIELDS {fields}".encode(), b"SIZE" + b" 4" * n, b"TYPE" + b" F" * n]
    kept += [] if count is None else [f"COUNT {count}".encode()]
    path.write_bytes(b"\n".join([line for line in kept if line]) + b"\nDATA" + data)
    points = read_pcd(path)
    np.testing.assert_array_equal(points[:, :3], POINTS)
    np.testing.assert_array_equal(points[:, 3], [0.0, 0.5, 1.0])


def test_points_with_nan_intensity_are_kept(tmp_path: Path) -> None:
    path = save(tmp_path / "a.pcd", Encoding.BINARY, "intensity", np.array([np.nan, 0.5, 1.0], dtype=np.float32))
    np.testing.assert_array_equal(read_pcd(path)[:, 3], [0.0, 0.5, 1.0])


@pytest.mark.parametrize(
    ("stored", "intensity"),
    [
        ([0.0, 0.5, 1.0], [0.0, 0.5, 1.0]),  # KITTI's own, and what DAIR-V2X's converter writes
        ([0.0, 51.0, 255.0], [0.0, 0.2, 1.0]),  # the sensor's numbers as they were
        ([-0.1, np.nan, 1.0], [0.0, 0.0, 1.0]),  # what is no intensity is 0
    ],
)
def test_intensities_of_bin_files(tmp_path: Path, stored: list[float], intensity: list[float]) -> None:
    np.column_stack([POINTS, stored]).astype("<f4").tofile(tmp_path / "a.bin")
    points = read_bin(tmp_path / "a.bin")
    np.testing.assert_array_equal(points[:, :3], POINTS)
    np.testing.assert_allclose(points[:, 3], intensity, rtol=1e-6)


@pytest.mark.parametrize(("content", "message"), [(b"", "is empty"), (b"0" * 20, "20 bytes are not a multiple of 16")])
def test_cut_bin_files_are_named(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.bin").write_bytes(content)
    with pytest.raises(ValueError, match=rf"a\.bin: {message}"):
        read_bin(tmp_path / "a.bin")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"POINTS 3\n", b"", "the header has no POINTS$"),
        (b"POINTS 3\n", b"POINTS three\n", "invalid literal .* 'three'"),
        (b"DATA ascii", b"DATA text", "data: Input should be "),
    ],
)
def test_a_broken_header_is_named_in_words(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    path = save(tmp_path / "a.pcd", Encoding.ASCII, "intensity", np.zeros(3, dtype=np.float32))
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new))
    with pytest.raises(ValueError, match=rf"a\.pcd: not readable as PCD: {message}"):
        read_pcd(path)
