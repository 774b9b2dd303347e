"""Pictures of a run as a series: numbered by their times, kept up to where a run goes on, animated at the end."""

import pytest
from mpi4py import MPI

from tigar_x.run.frames import Frames

pytest.importorskip("PIL")
pytestmark = pytest.mark.mpi


@pytest.fixture
def shared_path(tmp_path):
    return MPI.COMM_WORLD.bcast(tmp_path)


def pictures_of(path, times, *, after=None):
    from PIL import Image

    from tigar_x.ranks import root_only

    @root_only
    def draw(file, t):
        file.parent.mkdir(exist_ok=True, parents=True)
        Image.new("RGB", (8, 6), (round(255 * t), 0, 0)).save(file)

    with Frames(path, draw, after=after) as frames:
        for t in times:
            frames.write(t)
    names = [frame.name for frame in frames.frames]
    MPI.COMM_WORLD.barrier()  # before rank 0 deletes some for the next series
    return names


def test_pictures_become_an_animation_and_a_sheet(shared_path):
    from PIL import Image

    path = shared_path / "leaf.gif"
    assert pictures_of(path, [0.1, 0.25, 1.0]) == [
        f"leaf_{t}.png" for t in ("0.100000000", "0.250000000", "1.000000000")
    ]
    assert Image.open(path).n_frames == 3
    assert Image.open(path.with_suffix(".png")).size == (16, 12)


def test_a_run_that_goes_on_keeps_what_was_drawn_before(shared_path):
    path = shared_path / "leaf.gif"
    pictures_of(path, [0.1, 0.2, 0.3])
    assert len(pictures_of(path, [0.25], after=0.2)) == 3
    assert len(pictures_of(path, [0.5])) == 1


def test_other_endings_are_refused(shared_path):
    with pytest.raises(ValueError, match=r"^path = .*leaf.mp4': a name that ends in '.gif' is required"):
        Frames(shared_path / "leaf.mp4", lambda path, t: None)


def test_series_whose_names_begin_alike_do_not_touch_each_other(shared_path):
    pictures_of(shared_path / "leaf_top.gif", [0.1, 0.2])
    assert pictures_of(shared_path / "leaf.gif", [0.3]) == ["leaf_0.300000000.png"]
    assert len(list((shared_path / "frames").iterdir())) == 3
