"""Films: a picture that stands still costs nothing."""

import numpy as np


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
