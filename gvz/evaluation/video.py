"""Pictures to a video file: H.264 in MP4 by PyAV, animated GIF and WebP by Pillow; a GIF to TensorBoard."""

import importlib.util
import time
import uuid
from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np
from PIL import Image

from gvz.core.errors import ConfigError
from gvz.evaluation.playback import END_S

SUFFIXES = (".mp4", ".gif", ".webp")


def check_video_file(file: Path) -> None:
    """Checks that `write_video` can write such a file.

    Raises:
        ConfigError: another kind of file, or PyAV is missing for an MP4.
    """
    if file.suffix not in SUFFIXES:
        raise ConfigError(f"--out: got {file.name}, want a name that ends with {', '.join(SUFFIXES)}")
    if file.suffix == ".mp4" and importlib.util.find_spec("av") is None:
        raise ConfigError("--out: .mp4 needs PyAV: pip install 'gvizdoom[video]', or write .webp or .gif")


def write_video(file: Path, pictures: Iterable[Image.Image], rate: Fraction) -> None:
    """Writes a video.

    Args:
        file: where to; its suffix, one of SUFFIXES, says which kind.
        pictures: at least one, all of one size, both sides even. Each is read before the next one is taken.
        rate: pictures a second.
    """
    write = _write_mp4 if file.suffix == ".mp4" else _write_animation
    write(file, pictures, rate)


def add_to_tensorboard(gif: Path, directory: Path, tag: str, step: int) -> None:
    """Adds a .gif as the image `tag` of a gradient step; TensorBoard shows it moving.

    `directory` is for these events alone: TensorBoard stops reading a file when the directory holds a newer one.
    """
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]  # made at run time
    from tensorboardX.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]  # made at run time

    with Image.open(gif) as animation:
        width, height = animation.size
    image = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=gif.read_bytes())
    directory.mkdir(parents=True, exist_ok=True)
    events = EventsWriter(str(directory / "events"), f".{uuid.uuid4().hex}")  # else files of one second were one
    summary = Summary(value=[Summary.Value(tag=tag, image=image)])
    events.write_event(Event(step=step, wall_time=time.time(), summary=summary))
    events.close()


def _write_mp4(file: Path, pictures: Iterable[Image.Image], rate: Fraction) -> None:
    import av

    shown = _with_end(pictures, rate)
    first = next(shown)
    with av.open(str(file), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": "23", "preset": "veryfast"})
        stream.width, stream.height = first.size
        stream.pix_fmt = "yuv420p"  # what browsers play
        for picture in chain([first], shown):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.asarray(picture), format="rgb24")))
        container.mux(stream.encode())


def _with_end(pictures: Iterable[Image.Image], rate: Fraction) -> Iterator[Image.Image]:
    """The last picture stays."""
    picture = None
    for picture in pictures:
        yield picture
    if picture is not None:
        for _ in range(round(END_S * rate)):
            yield picture


def _write_animation(file: Path, pictures: Iterable[Image.Image], rate: Fraction) -> None:
    shown = [picture.copy() for picture in pictures]
    durations_ms = [round(1000 / rate)] * (len(shown) - 1) + [round(1000 * END_S)]
    shown[0].save(file, save_all=True, append_images=shown[1:], duration=durations_ms, loop=0, quality=70, method=4)
