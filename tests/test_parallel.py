"""The tests marked mpi pass on two ranks, splines and fields with two sides give the same on one, two and three."""

import json

import few_cells
import numpy as np
import pytest
import sharp_scenes
from mpi4py import MPI
from mpi_runs import MPIRUN, mpirun
from on_disk import ROOT

pytestmark = [
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="already parallel"),
    pytest.mark.skipif(MPIRUN is None, reason="no mpirun"),
]


def test_two_ranks():
    done = mpirun(2, "-m", "pytest", "-q", "-m", "mpi", "-p", "no:cacheprovider", "--color=no", ROOT / "tests")
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    assert done.stdout.count(" passed") == 2


def test_standalone_splines_do_not_depend_on_the_number_of_ranks():
    results = {}
    for ranks in (1, 2, 3):
        done = mpirun(ranks, ROOT / "tests" / "standalone.py")
        assert done.returncode == 0, done.stderr[-3000:]
        results[ranks] = json.loads(done.stdout.splitlines()[-1])
    assert len(results[1]) >= 4
    for ranks in (2, 3):
        for name, values in results[1].items():
            scale = np.abs(values).max()
            np.testing.assert_allclose(results[ranks][name], values, rtol=0, atol=1e-9 * scale, err_msg=name)


def test_ranks_may_be_more_than_cells(tmp_path):
    """Splines of one element, and a flow and a sheet in two triangles, are the same on three ranks as on one."""
    expected = few_cells.main(tmp_path / "one")
    done = mpirun(3, ROOT / "tests" / "few_cells.py", tmp_path / "three")
    assert done.returncode == 0, done.stderr[-3000:]
    results = json.loads(done.stdout.splitlines()[-1])
    assert len(expected) == 3
    for name, values in expected.items():
        scale = np.abs(values).max()
        np.testing.assert_allclose(results[name], values, rtol=0, atol=1e-9 * scale, err_msg=name)


def test_fields_that_differ_on_both_sides_do_not_depend_on_the_number_of_ranks():
    """A membrane, an opening valve, a dome, each step solved as far as rounding allows; leaflets are mirror images."""
    expected = sharp_scenes.main()
    for ranks in (2, 3):
        done = mpirun(ranks, ROOT / "tests" / "sharp_scenes.py")
        assert done.returncode == 0, done.stderr[-3000:]
        results = json.loads(done.stdout.splitlines()[-1])
        for scene, figures in expected.items():
            for name, values in figures.items():
                scale = np.abs(values).max()
                np.testing.assert_allclose(
                    results[scene][name], values, rtol=0, atol=1e-9 * scale, err_msg=f"{scene} {name} {ranks}"
                )
    leaflets = np.array(expected["valve"]["tips"])
    assert np.abs(leaflets).max() > 0.1
    np.testing.assert_allclose(leaflets[1] * [1.0, -1.0], leaflets[0], rtol=0, atol=1e-10)
