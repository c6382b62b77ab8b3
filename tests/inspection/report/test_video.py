"""Films: of a run, of episodes as fast as they were; a picture that stands still costs nothing."""

from dataclasses import replace

import numpy as np
import pytest
from toys import CRAWL, CRAWLER_ROBOTS

from toolkit.errors import ToolkitError
from toolkit.expert.training import new_learner
from toolkit.inspection.trajectory import replay
from toolkit.learning.policy import MeanActor
from toolkit.simulation.laws import native_plant


def test_what_stands_still_in_a_gif_is_the_same_in_every_picture(tmp_path):
    """A wall shaded softly, and a square that crosses it, changing its colour: with a palette per picture the wall would flicker."""
    from PIL import Image, ImageSequence

    from toolkit.inspection.report import video

    wall = np.stack([np.add.outer(np.linspace(60, 200, 540), np.linspace(0, 50, 720))] * 3, axis=2).astype(np.uint8)

    def pictures():
        for k in range(30):
            picture = wall.copy()
            picture[400:460, 20 * k : 20 * k + 60] = (255 - 8 * k, 8 * k, 90)
            yield Image.fromarray(picture)

    assert video._write_gif(tmp_path / "film.gif", pictures()) == 30
    with Image.open(tmp_path / "film.gif") as film:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
    assert len(frames) == 15 and frames[0].shape == (360, 480, 3)
    assert all(np.array_equal(frame[:250], frames[0][:250]) for frame in frames), "the wall flickers"
    assert len({frame[285, 5 + 14 * k].tobytes() for k, frame in enumerate(frames)}) > 3, "the square's colours are told apart"


@pytest.mark.parametrize("suffix", ["mp4", "gif"])
@pytest.mark.slow
def test_a_run_becomes_a_film(tmp_path, stored, suffix):
    """As long as it says, in colour, and its last picture is the target, standing."""
    import cv2
    from PIL import Image, ImageSequence

    from toolkit.inspection.report import video

    video_size, video.SIZE = video.SIZE, (160, 120)
    try:
        seconds = video.write_video(stored.folder, stored.merged, stored.tree(), stored.policy, stored.native, tmp_path / f"film.{suffix}")
    except ToolkitError as error:
        pytest.skip(str(error))
    finally:
        video.SIZE = video_size
    file = tmp_path / f"film.{suffix}"
    if suffix == "mp4":
        reader = cv2.VideoCapture(str(file))
        frames = []
        while (answer := reader.read())[0]:
            frames.append(answer[1][..., ::-1])
    else:
        frames = [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(Image.open(file))]
    assert 5.0 < seconds < 60.0 and file.stat().st_size > 10_000
    if suffix == "mp4":
        assert abs(len(frames) - seconds * video.RATE) <= 1
    apart = [np.abs(a.astype(int) - b).mean() for a, b in zip(frames, frames[1:], strict=False)]
    assert max(apart) > 1.0 and min(apart) < 1.0, "something moves, and something rests"
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 2.0, "the hand has become the Jaco"


def test_a_run_without_episodes_makes_no_film(tmp_path, stored):
    from toolkit.inspection.report import video

    with pytest.raises(ToolkitError, match="keeps no phases to show"):
        video.write_video(tmp_path, stored.merged, stored.tree(), stored.policy, stored.native, tmp_path / "film.mp4")


@pytest.mark.parametrize("frequency, frames", [(20.0, list(range(11))), (100.0, [0, 5, 10]), (10.0, sorted([*range(11)] * 2))])
def test_a_films_episodes_are_as_fast_as_they_were(frequency, frames):
    """A film has 20 pictures a second, whatever the task has policy steps."""
    from toolkit.inspection.report import video

    task = replace(CRAWL, control_frequency=frequency, horizon=10, goal=9.0)
    film = replay(native_plant(CRAWLER_ROBOTS[0], task), MeanActor(new_learner(task, 0)[0]), 0, np.zeros(1))
    assert len(film.qpos) == 11 and video._frames(film) == frames
