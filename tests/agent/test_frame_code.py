"""Frames of a synthetic camera: their pixels, and the values that are read after compression, noise and damage."""

import io
import random
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from fieldkit.agent.video.frame_code import BLACK, COLUMNS, MAX_NUMBER, ROWS, WHITE, FrameCode
from fieldkit.agent.video.image_message import ImageCodec
from fieldkit.ros.interfaces.types import standard_types

WIDTH, HEIGHT, NOISE_ROWS = 160, 96, 16
SMALL = FrameCode(WIDTH, HEIGHT, NOISE_ROWS)
NUMBERS = st.integers(0, MAX_NUMBER)
TIMES_NS = st.integers(0, 2**64 - 1)


def compress(luma: bytes, quality: int) -> bytes:
    """Return the pixels of a frame after JPEG compression."""
    file = io.BytesIO()
    Image.frombytes("L", (WIDTH, HEIGHT), luma).save(file, "JPEG", quality=quality)
    return Image.open(file).tobytes()


def test_cells_are_the_bits_of_number_time_and_checksum() -> None:
    """The oracle is a decoder that computes the mean of each cell with numpy."""
    number, at_ns = 77, 1_795_000_000_123_456_789
    content = number.to_bytes(4, "big") + at_ns.to_bytes(8, "big")
    expected = content + zlib.crc32(content).to_bytes(4, "big")
    pixels = np.frombuffer(SMALL.luma(number, at_ns), np.uint8).reshape(HEIGHT, WIDTH)
    cells = pixels[: HEIGHT - NOISE_ROWS].reshape(ROWS, -1, COLUMNS, WIDTH // COLUMNS).mean(axis=(1, 3))
    assert set(cells.flat) == {BLACK, WHITE}
    assert np.packbits(cells.ravel() == WHITE).tobytes() == expected
    assert len(np.unique(pixels[HEIGHT - NOISE_ROWS :])) > 200, "the noise rows are random"


@given(NUMBERS, TIMES_NS, st.integers(0, 2**32), st.sampled_from([5, 10, 30, 85, 100]))
def test_number_and_time_are_read_after_compression_and_noise(
    number: int, at_ns: int, seed: int, quality: int
) -> None:
    noise = np.random.default_rng(seed).normal(0, 40, WIDTH * HEIGHT)
    pixels = np.frombuffer(compress(SMALL.luma(number, at_ns), quality), np.uint8)
    assert SMALL.read(pixels.tobytes()) == (number, at_ns)
    noisy = np.clip(pixels + noise, 0, 255).astype(np.uint8).tobytes()
    assert SMALL.read(noisy) in {(number, at_ns), None}


@given(NUMBERS, TIMES_NS, st.integers(0, WIDTH * HEIGHT - 1))
def test_truncated_frame_has_no_value(number: int, at_ns: int, size: int) -> None:
    assert SMALL.read(SMALL.luma(number, at_ns)[:size]) is None


@given(st.tuples(NUMBERS, TIMES_NS), st.tuples(NUMBERS, TIMES_NS), st.integers(0, HEIGHT), st.sampled_from("xy"))
def test_a_mixture_of_two_frames_has_the_values_of_a_frame_or_none(
    old_values: tuple[int, int], new_values: tuple[int, int], border: int, axis: str
) -> None:
    """A video decoder shows the old pixels where packets of the new frame are missing."""
    old_pixels, new_pixels = (
        np.frombuffer(SMALL.luma(*frame), np.uint8).reshape(HEIGHT, WIDTH) for frame in (old_values, new_values)
    )
    parts = (
        (old_pixels[:border], new_pixels[border:])
        if axis == "y"
        else (old_pixels[:, :border], new_pixels[:, border:])
    )
    mixture = np.concatenate(parts, axis=0 if axis == "y" else 1)
    assert SMALL.read(mixture.tobytes()) in {old_values, new_values, None}


def test_altered_cells_are_never_read_as_another_value() -> None:
    frame, random_generator = SMALL.luma(5, 1_795_000_000_000_000_000), random.Random(1)
    cell_width, cell_height = WIDTH // COLUMNS, (HEIGHT - NOISE_ROWS) // ROWS
    for _ in range(300):
        pixels = np.frombuffer(frame, np.uint8).reshape(HEIGHT, WIDTH).copy()
        for _ in range(random_generator.randint(1, 40)):
            top, left = (
                random_generator.randrange(ROWS) * cell_height,
                random_generator.randrange(COLUMNS) * cell_width,
            )
            pixels[top : top + cell_height, left : left + cell_width] = random_generator.choice([BLACK, WHITE, 128])
        if pixels.tobytes() != frame:
            assert SMALL.read(pixels.tobytes()) is None


@pytest.mark.parametrize("level", [0, 16, 128, 235, 255])
def test_uniform_frame_has_no_value(level: int) -> None:
    assert SMALL.read(bytes([level]) * WIDTH * HEIGHT) is None


@pytest.mark.parametrize("size", [(128, 64, 0), (640, 480, 48), (2032, 2032, 1016)])
def test_frames_of_different_sizes_are_read(size: tuple[int, int, int]) -> None:
    code = FrameCode(*size)
    frame = code.luma(3, 4)
    assert len(frame) == size[0] * size[1]
    assert code.read(frame + b"chroma") == (3, 4)


@pytest.mark.ros
@pytest.mark.parametrize("ros1", [True, False])
def test_message_is_an_image(*, ros1: bool) -> None:
    """Equal to the serialization of rosbags for ROS 1 and ROS 2."""
    at_ns, sample_header = 1_795_000_000_123_456_789, b"head of the sample"
    data = ImageCodec(WIDTH, HEIGHT, ros1=ros1).encode(7, at_ns, sample_header)
    types, name = standard_types(), "sensor_msgs/msg/Image"
    message = types.ros1.deserialize_ros1(data, name) if ros1 else types.ros2.deserialize_cdr(data, name)
    serialized_again = types.ros1.serialize_ros1(message, name) if ros1 else types.ros2.serialize_cdr(message, name)
    assert bytes(serialized_again) == data
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(at_ns, 10**9)  # type: ignore[attr-defined]
    assert (message.width, message.height, message.step, message.encoding) == (WIDTH, HEIGHT, WIDTH, "mono8")  # type: ignore[attr-defined]
    pixels = np.asarray(message.data).tobytes()  # type: ignore[attr-defined]
    assert pixels[: len(sample_header)] == sample_header
    assert FrameCode(WIDTH, HEIGHT).read(pixels) == (7, at_ns)
    codec = ImageCodec(WIDTH, HEIGHT, ros1=ros1)
    assert codec.decode(data) == codec.decode(data + b"\0\0\0") == (7, at_ns)
    assert codec.decode(data[:-1]) is codec.decode(data + bytes(4)) is None
