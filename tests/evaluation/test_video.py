"""Video files: what is written can be read."""

import sys
from fractions import Fraction

import av
import numpy as np
import pytest
from PIL import Image

from gvz.core.errors import ConfigError
from gvz.evaluation.video import check_video_file, write_video

GREYS = [0, 60, 120, 180, 240]


def pictures(num=5):
    """One image, drawn over for every picture."""
    picture = Image.new("RGB", (64, 48))
    for grey in GREYS[:num]:
        picture.paste((grey, grey, grey), (0, 0, 64, 48))
        yield picture


def test_an_mp4_has_every_picture_and_stays_at_the_last(tmp_path):
    file = tmp_path / "video.mp4"
    write_video(file, pictures(), Fraction(10))
    with av.open(str(file)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert stream.average_rate == 10
        shown = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert shown[0].shape == (48, 64, 3)
    np.testing.assert_allclose([frame.mean() for frame in shown], [*GREYS, *[240] * 15], atol=6)


@pytest.mark.parametrize(("suffix", "duration_ms"), [(".webp", 114), (".gif", 110)])
def test_an_animation_has_every_picture_and_stays_at_the_last(tmp_path, suffix, duration_ms):
    file = tmp_path / f"video{suffix}"
    write_video(file, pictures(), Fraction(35, 4))
    shown, durations = [], []
    with Image.open(file) as animation:
        assert animation.info["loop"] == 0
        for n in range(animation.n_frames):
            animation.seek(n)
            animation.load()
            shown.append(np.asarray(animation.convert("RGB")).mean())
            durations.append(animation.info["duration"])
    np.testing.assert_allclose(shown, GREYS, atol=6)
    assert durations == [duration_ms] * 4 + [1500]


def test_another_kind_of_file_is_an_error(tmp_path):
    with pytest.raises(ConfigError, match=r"--out: got video\.avi, want a name that ends with \.mp4, \.gif, \.webp"):
        check_video_file(tmp_path / "video.avi")


def test_without_pyav_an_mp4_is_an_error_that_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)  # as if it were not installed
    with pytest.raises(ConfigError, match=r"pip install 'gvizdoom\[video\]', or write \.webp or \.gif"):
        check_video_file(tmp_path / "video.mp4")
    check_video_file(tmp_path / "video.webp")
