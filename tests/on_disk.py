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


def read_vtkhdf_meshes(path):
    """Time, points, simplices and fields of every step of a file with a mesh for each, as the format's offsets say."""
    import h5py

    found = []
    with h5py.File(path, "r") as file:
        root = file["VTKHDF"]
        assert (root.attrs["Type"], tuple(root.attrs["Version"])) == (b"UnstructuredGrid", (2, 0))
        steps = root["Steps"]
        assert steps.attrs["NSteps"] == len(steps["Values"]) == len(root["NumberOfPoints"])
        assert np.all(steps["NumberOfParts"][:] == 1)
        for i, t in enumerate(steps["Values"]):
            part = int(steps["PartOffsets"][i])
            points, cells, ids = (int(root[f"NumberOf{name}"][part]) for name in ("Points", "Cells", "ConnectivityIds"))
            first = int(steps["PointOffsets"][i])
            of_cells, of_ids = (int(steps[f"{name}Offsets"][i][0]) for name in ("Cell", "ConnectivityId"))
            x = root["Points"][first : first + points]
            offsets = root["Offsets"][of_cells + part : of_cells + part + cells + 1]  # a part has one more than cells
            kinds = root["Types"][of_cells : of_cells + cells]
            vertices = {5: 3, 10: 4}[int(kinds[0])]  # triangles, tetrahedra
            assert (kinds == kinds[0]).all()
            assert (offsets == vertices * np.arange(cells + 1)).all()
            simplices = root["Connectivity"][of_ids : of_ids + ids].reshape(-1, vertices)
            begins = {name: int(steps["PointDataOffsets"][name][i]) for name in root["PointData"]}
            fields = {name: root["PointData"][name][b : b + points] for name, b in begins.items()}
            found.append((float(t), x, simplices, fields))
        assert len(root["Points"]) == sum(len(x) for _, x, _, _ in found)
    return found
