"""The demos, found on disk, and readers of what runs write."""

from itertools import pairwise
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
DEMOS = sorted(path.stem for path in (ROOT / "demos").glob("*.py"))


def read_vtkhdf(path):
    """Points, cells of VTK by their number, and (time, fields) of every step, as the format's offsets say."""
    import h5py

    with h5py.File(path, "r") as file:
        root = file["VTKHDF"]
        assert (root.attrs["Type"], tuple(root.attrs["Version"])) == (b"UnstructuredGrid", (2, 0))
        points, cells = int(root["NumberOfPoints"][0]), int(root["NumberOfCells"][0])
        offsets, connectivity = root["Offsets"][:], root["Connectivity"][:]
        assert len(root["Points"]) == points
        assert len(offsets) == cells + 1
        assert len(root["Types"]) == cells
        assert offsets[-1] == len(connectivity) == root["NumberOfConnectivityIds"][0]
        steps = root["Steps"]
        assert steps.attrs["NSteps"] == len(steps["Values"])
        for name in ("PartOffsets", "PointOffsets", "CellOffsets", "ConnectivityIdOffsets"):
            assert len(steps[name]) == len(steps["Values"])
            assert not np.any(steps[name])
        assert np.all(steps["NumberOfParts"][:] == 1)
        found = []
        for i, t in enumerate(steps["Values"]):
            begins = {name: int(steps["PointDataOffsets"][name][i]) for name in root["PointData"]}
            found.append((float(t), {name: root["PointData"][name][b : b + points] for name, b in begins.items()}))
        corners = [connectivity[i:j] for i, j in pairwise(offsets)]
        return root["Points"][:], list(zip(root["Types"], corners, strict=True)), found
