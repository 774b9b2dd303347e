"""Pictures: what every axis says, who writes, what hides what, and that nothing is loaded without need."""

import subprocess
import sys

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import fem, mesh
from mpi_runs import outside

from tigar_x import compat
from tigar_x.fem.eigen import Eigenpairs
from tigar_x.geometry import shapes
from tigar_x.geometry.multipatch import disjoint
from tigar_x.run.figure import axis_label, draw, lines, over_time
from tigar_x.run.history import History
from tigar_x.run.pictures import Colours, animate
from tigar_x.run.plane_field import PlaneField
from tigar_x.splines import sampling
from tigar_x.splines.flow_pictures import flow_scene
from tigar_x.splines.modes import mode_curves, write_modes
from tigar_x.splines.pictures import Surface, View, draw_shell, family, nice_length, scene, surfaces
from tigar_x.splines.spline import ExtractedSpline

COMM = MPI.COMM_WORLD


@pytest.fixture
def folder(tmp_path):
    """One folder for all ranks."""
    return COMM.bcast(tmp_path)


@pytest.fixture
def saved(monkeypatch):
    """The figures that this rank has saved."""
    from matplotlib.figure import Figure

    found, save = [], Figure.savefig

    def kept(self, *args, **kwargs):
        found.append(self)
        return save(self, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", kept)
    return found


def texts(drawn):
    """All texts of a figure."""
    from matplotlib.text import Text

    return [t.get_text() for t in drawn.findobj(Text) if t.get_text()]


# -- labels and units -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("what", "unit"), [("", "s"), ("time", ""), ("time", " "), (None, "s"), ("time", None)])
def test_a_label_needs_a_name_and_a_unit(what, unit):
    with pytest.raises(ValueError, match="a text is required"):
        axis_label(what, unit)
    with pytest.raises(ValueError, match="a text is required"):
        Colours(what, unit)
    with pytest.raises(ValueError, match="a text is required"):
        lines({}, x=("t", "s"), y=(what, unit))


@pytest.mark.mpi
@pytest.mark.parametrize(
    "labels", [{"xlabel": "t [s]"}, {"xlabel": "t [s]", "ylabel": "flow rate"}, {"xlabel": "[s]", "ylabel": "q [m]"}]
)
def test_a_figure_with_an_axis_without_name_or_unit_is_not_made(labels, folder):
    with pytest.raises(ValueError, match=r"q.png: the [xy] axis of the axes 'flow' has the label"):
        draw(folder / "q.png", lambda axes: axes.set(title="flow", **labels))
    assert not list(folder.iterdir())


def test_a_bar_of_colours_without_a_unit_is_found(tmp_path):
    from matplotlib.cm import ScalarMappable

    def panel(axes):
        axes.set(xlabel="x [m]", ylabel="y [m]")
        axes.figure.colorbar(ScalarMappable(), ax=axes, label="speed")

    with pytest.raises(ValueError, match="the y axis of the axes has the label 'speed'"):
        draw(tmp_path / "speed.png", panel)


LINE = lines({"a": ([0, 1], [0, 1])}, x=("t", "s"), y=("p", "Pa"))


def test_axes_without_ticks_need_a_scale_and_those_between_others_no_label(tmp_path):
    def shape(axes):
        axes.plot([0, 1], [0, 1])
        axes.set_axis_off()

    def shared(axes):
        LINE(axes)
        axes.set_xlabel("")
        axes.tick_params(labelbottom=False)

    with pytest.raises(ValueError, match="neither ticks nor a scale bar"):
        draw(tmp_path / "shape.png", shape)
    draw(tmp_path / "shared.png", shared, LINE, columns=1)
    assert [path.name for path in tmp_path.iterdir()] == ["shared.png"]


@pytest.mark.mpi
def test_rank_0_alone_saves_and_an_error_of_one_rank_is_one_of_all(folder, saved):
    draw(folder / "new" / "ranks.png", LINE)
    assert len(saved) == (COMM.rank == 0)
    assert (folder / "new" / "ranks.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ZeroDivisionError):
        draw(folder / "failed.png", LINE, lambda _: 1 / COMM.rank)
    assert not (folder / "failed.png").exists()


@pytest.mark.parametrize(
    ("panels", "options", "places"),
    [
        ([LINE] * 3, {}, [(0, 0, 1), (0, 1, 1), (1, 0, 1)]),
        ([LINE] * 2, {"columns": 3}, [(0, 0, 1), (0, 1, 1)]),
        ([LINE, [LINE] * 2], {"heights": (2, 1)}, [(0, 0, 2), (1, 0, 1), (1, 1, 1)]),
        ([[LINE] * 2, [LINE] * 3], {}, [(0, 0, 3), (0, 3, 3), (1, 0, 2), (1, 2, 2), (1, 4, 2)]),
    ],
)
def test_panels_stand_in_columns_or_fill_their_rows(panels, options, places, tmp_path, saved):
    draw(tmp_path / "panels.png", *panels, size=(2.5, 2), dpi=20, **options)
    specs = [axes.get_subplotspec() for axes in saved[0].axes]
    assert [(s.rowspan.start, s.colspan.start, len(s.colspan)) for s in specs] == places


def test_a_figure_needs_panels_and_a_height_for_every_row(tmp_path):
    for panels in ([], [LINE, []]):
        with pytest.raises(ValueError, match="panels is empty"):
            draw(tmp_path / "empty.png", *panels)
    with pytest.raises(ValueError, match="heights = "):
        draw(tmp_path / "rows.png", LINE, heights=(1, 2))


def test_a_history_names_its_quantities_units_and_levels(tmp_path, saved):
    t = np.linspace(0.0, 1.0, 5)
    history = History(("t_alpha", "q", "p_1"), np.column_stack([t, t - 0.1, t**2, 1.0 - t]))
    draw(
        tmp_path / "histories.png",
        over_time(history, "q", y=("flow rate", "cm³/s"), time="s", over="t_alpha", levels={"limit": 0.4}, ylim=(0, 2)),
        over_time(history, {"before the valve": "p_1"}, y=("pressure", "dyn/cm²"), time="s", yscale="log"),
        over_time(
            history, "q", y=("flow rate", "l/h"), time="s", points={"measured": ([0.5], [0.3]), "known": ([0.1], [0.3])}
        ),
    )
    axes = saved[0].axes
    assert [one.get_xlabel() for one in axes] == ["$t$ [s]"] * 3
    assert [one.get_ylabel() for one in axes] == ["flow rate [cm³/s]", "pressure [dyn/cm²]", "flow rate [l/h]"]
    assert {"limit", "before the valve", "measured", "known"} <= set(texts(saved[0]))
    assert len({line.get_marker() for line in axes[2].lines}) == 3
    np.testing.assert_array_equal(axes[0].lines[0].get_xdata(), t - 0.1)
    assert axes[0].get_ylim() == (0.0, 2.0)
    assert axes[1].get_yscale() == "log"


# -- colours ----------------------------------------------------------------------------------------------------------


def test_the_ends_of_a_scale_are_those_given_or_those_of_the_values():
    assert Colours("p", "Pa").ends([1.0, np.nan, 3.0]) == (1.0, 3.0)
    assert Colours("p", "Pa", low=0.0).ends([1.0, 3.0]) == (0.0, 3.0)
    assert Colours("p", "Pa", low=-2.0, high=2.0).ends([1.0, 3.0]) == (-2.0, 2.0)
    for constant in (Colours("p", "Pa"), Colours("p", "Pa", high=4.0), Colours("p", "Pa", low=4.0)):
        low, high = constant.ends([4.0])
        assert low < high
    assert Colours("p", "Pa").ends([]) == (0.0, 1.0)
    with pytest.raises(ValueError, match=r"low = 2\.0: a number below high = 2\.0"):
        Colours("p", "Pa", 2.0, 2.0)


@pytest.mark.parametrize(("high", "extend"), [(None, "neither"), (0.5, "max"), (1.0, "neither")])
def test_a_bar_says_what_and_whether_values_lie_beyond_it(high, extend, tmp_path):
    bars = []

    def panel(axes):
        axes.set(xlabel="x [m]", ylabel="y [m]")
        bars.append(Colours("speed", "m/s", high=high).bar(axes, [0.0, 1.0]))

    draw(tmp_path / "bar.png", panel)
    assert bars[0].ax.get_ylabel() == "speed [m/s]"
    assert bars[0].extend == extend


@pytest.mark.mpi
def test_a_plane_flow_with_streamlines_and_immersed_lines(folder, saved):
    domain = mesh.create_rectangle(COMM, [[0.0, 0.0], [2.0, 1.0]], [8, 4])
    w = fem.Function(compat.lagrange_space(domain, 1, 3))
    w.interpolate(lambda x: np.array([x[1] * (1.0 - x[1]), 0.01 * x[0], x[0]]))
    flow = PlaneField(w)
    curves, colours = [np.array([[1.0, 0.0, 7.0], [1.1, 0.5, 7.0]])] * 2, Colours("pressure", "dyn/cm²")
    panel = flow.panel(flow.values[:, 2], colours, length="cm", title="t = 0.1 s", density=0.5, immersed=curves)
    draw(folder / "flow.png", panel, flow.speed("cm/s", length="cm"))
    assert (folder / "flow.png").exists()
    if COMM.rank == 0:
        found = {"$x_1$ [cm]", "$x_2$ [cm]", "pressure [dyn/cm²]", "speed [cm/s]", "t = 0.1 s"}
        assert found <= set(texts(saved[0]))
        axes = saved[0].axes[0]
        assert axes.get_xlim() == pytest.approx((0.0, 2.0))
        np.testing.assert_array_equal(axes.lines[-1].get_xydata(), curves[1][:, :2])


# -- shells -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sheets():
    """Two plates above each other, at x_3 = 0 and 1."""
    plates = [shapes.plate(lengths=(2.0, 1.0), center=(0.0, 0.0, z), elements=(2, 1), degrees=(2, 2)) for z in (0, 1)]
    return ExtractedSpline(disjoint(*plates), MPI.COMM_SELF)


def test_a_view_keeps_lengths_and_looks_where_it_says():
    np.testing.assert_allclose(View(90.0, -90.0).axes, np.eye(3), atol=1e-15)
    for view in (View(12.0, 20.0), View(-35.0, 200.0)):
        np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(view.axes) == pytest.approx(1.0)
    assert View(0.0, 0.0).seen([1.0, 2.0, 3.0]) == pytest.approx([2.0, 3.0, 1.0])
    with pytest.raises(ValueError, match="elevation = 91"):
        View(91.0, 0.0)


@pytest.mark.parametrize(("elevation", "upper_last"), [(80.0, True), (-80.0, False)])
def test_the_nearer_surface_hides_the_farther_one(sheets, elevation, upper_last, tmp_path, saved):
    net = sampling.net(sheets, 3)
    shown = [Surface.of_net(x, colour=colour) for x, colour in zip(net.reference, ("b", "r"), strict=True)]
    draw(tmp_path / "sheets.png", scene(shown, length="cm", view=View(elevation, 30.0)))
    axes = saved[0].axes[0]
    red, blue = axes.collections[0].get_facecolors()[:, [0, 2]].T
    assert ((red > blue)[4:] == upper_last).all()
    assert ((red > blue)[:4] != upper_last).all()


def test_a_shell_has_its_field_a_bar_of_length_and_the_directions_of_the_axes(sheets, tmp_path, saved):
    net, field = sampling.net(sheets, 5), sheets.project(sheets.F[2])
    y = sheets.function(np.outer(sheets.geometry.weights, (0.0, 0.0, 1.0)))
    colours = Colours("height", "mm", 0.0, 1.0, "gray")
    draw_shell(
        tmp_path / "shell.png", surfaces(net, y, field), colours=colours, length="mm", views=(View(), View(90, -90))
    )
    found = texts(saved[0])
    assert found.count("0.5 mm") == 2
    assert "height [mm]" in found
    assert "$x_3$" in found
    paints = saved[0].axes[1].collections[0].get_facecolors()[:, 0]
    assert paints.max() < 1.0 + 1e-12
    assert paints[:16].max() < 1e-3 < 0.7 < paints[16:].min()  # black below, white above, with some shade


def test_values_need_a_scale_of_colours_and_nets_lie_in_space(sheets, tmp_path):
    shown = surfaces(sampling.net(sheets, 2), field=sheets.project(sheets.F[0]))
    with pytest.raises(ValueError, match="colours = None"):
        draw_shell(tmp_path / "shell.png", shown, length="m")
    with pytest.raises(ValueError, match="unit = ''"):
        draw_shell(tmp_path / "shell.png", shown, length="", colours=Colours("x", "m"))
    with pytest.raises(ValueError, match="a scalar is required"):
        surfaces(sampling.net(sheets, 2), field=sheets.project(sheets.F))
    with pytest.raises(ValueError, match="nets in space are required"):
        surfaces(sampling.line(sheets, 0, 3, patch=0))
    with pytest.raises(ValueError, match="shown is empty"):
        draw_shell(tmp_path / "shell.png", [], length="m")
    assert not list(tmp_path.iterdir())


def test_a_box_keeps_the_frame_still_and_cuts_nothing_off(sheets, tmp_path, saved):
    for factor in (1.0, 0.3):
        shown = [Surface.of_net(factor * x) for x in sampling.net(sheets, 2).reference]
        draw(tmp_path / "frame.png", scene(shown, length="m", box=[[-1, -1, 0], [1, 1, 1]]))
    draw(
        tmp_path / "frame.png",
        scene(
            [Surface.of_net(2.0 * sampling.net(sheets, 2, patch=0).reference)],
            length="m",
            box=[[-1, -1, 0], [1, 1, 1]],
            view=View(90.0, -90.0),
        ),
    )
    first, second = ((one.axes[0].get_xlim(), one.axes[0].get_ylim()) for one in saved[:2])
    assert first == second
    assert saved[2].axes[0].get_xlim() == pytest.approx((-2.12, 2.12))  # nothing is cut off


def test_curves_under_load_have_one_scale_and_the_bar_of_their_load(tmp_path, saved):
    line = np.column_stack([np.linspace(0.0, 1.0, 4), np.zeros(4), np.arange(4.0)])
    load = {"colours": Colours("load", "kN"), "values": [0.0, 3.0]}
    draw(tmp_path / "curves.png", family([line, 2.0 * line], length="m", coordinates=(0, 2), **load))
    axes = saved[0].axes[0]
    assert axes.get_ylabel() == "$x_3$ [m]"
    assert axes.get_aspect() == 1.0
    assert "load [kN]" in texts(saved[0])
    np.testing.assert_array_equal(axes.lines[1].get_ydata(), 2.0 * np.arange(4.0))
    with pytest.raises(ValueError, match="colours and values belong together"):
        family([line], length="m", values=[1.0])


def test_lengths_of_bars_are_round():
    assert [nice_length(most) for most in (0.3, 1.0, 4.99, 73.0, 0.0021)] == pytest.approx([0.2, 1.0, 2.0, 50.0, 0.002])


# -- flows in space ---------------------------------------------------------------------------------------------------


def swirl(domain):
    """Velocity and pressure of a flow that turns about the third axis and rises along it."""
    w = fem.Function(compat.lagrange_space(domain, 1, 4))
    w.interpolate(lambda x: np.array([-x[1], x[0], 1.0 + 0.0 * x[0], x[2]]))
    return w


@pytest.mark.mpi
def test_a_flow_in_space_says_that_pyvista_is_missing_on_all_ranks(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    w = swirl(mesh.create_box(COMM, [[-1.0] * 3, [1.0] * 3], [2, 2, 2]))
    with pytest.raises(ImportError, match="flow_scene needs pyvista, which is not installed: pip install pyvista"):
        flow_scene(w, colours=Colours("speed", "m/s"), length="m")
    plane = fem.Function(compat.lagrange_space(mesh.create_unit_square(COMM, 2, 2), 1, 3))
    with pytest.raises(ValueError, match="w lies in 2 dimensions"):
        flow_scene(plane, colours=Colours("speed", "m/s"), length="m")


def test_a_flow_in_space_with_a_shell_in_it(sheets, tmp_path, saved):
    pytest.importorskip("pyvista")
    w = swirl(mesh.create_box(MPI.COMM_SELF, [[-1.0] * 3, [1.0, 1.0, 2.0]], [4, 4, 4]))
    shells, colours = surfaces(sampling.net(sheets, 3)), Colours("speed", "m/s")
    draw(tmp_path / "flow.png", flow_scene(w, shells, colours=colours, length="m", level=1.2, pixels=120))
    assert {"speed [m/s]", "0.5 m", "$x_3$"} <= set(texts(saved[0]))
    assert saved[0].axes[0].images[0].get_array().std() > 10.0


# -- animations, and what is loaded -----------------------------------------------------------------------------------


@pytest.mark.mpi
def test_an_animation_has_all_frames_and_the_sheet_six(folder):
    from PIL import Image

    names = [folder / "frames" / f"{n}.png" for n in range(8)]
    for n, name in enumerate(names):
        draw(name, lambda axes, n=n: axes.figure.set_facecolor((n / 8, 0.0, 0.0)) or LINE(axes), size=(2.5, 2), dpi=16)
    animate(folder / "movie.gif", names, seconds=0.2, sheet=folder / "sheet.png")
    with Image.open(folder / "movie.gif") as movie, Image.open(folder / "sheet.png") as sheet:
        assert movie.n_frames == 8
        assert movie.info["duration"] == 200
        assert sheet.size == (80, 96)
    animate(folder / "nothing.gif", [])
    assert not (folder / "nothing.gif").exists()


def test_matplotlib_comes_with_the_first_figure_and_pyplot_never(tmp_path):
    code = f"""
import sys
from pathlib import Path
import tigar_x.run.pictures, tigar_x.run.plane_field, tigar_x.run.convergence, tigar_x.splines.pictures
before = {{"matplotlib", "PIL"}} & set(sys.modules)
tigar_x.run.figure.draw(Path({str(tmp_path)!r}) / "a.png", lambda axes: axes.set(xlabel="x [m]", ylabel="y [m]"))
print(sorted(before), "matplotlib" in sys.modules, "matplotlib.pyplot" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=outside())
    assert done.stdout.split("\n")[-2] == "[] True False"


# -- modes ------------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_modes_are_shown_by_their_largest_values_at_their_frequencies(folder, saved, monkeypatch):
    spline = ExtractedSpline(shapes.line((0.0, 0.0), (2.0, 0.0), elements=4, degree=2), COMM)
    shapes_of_modes = [np.outer(rise, [0.0, 1.0]) for rise in (np.linspace(0.0, -8.0, 6), np.linspace(0.25, 0.0, 6))]
    functions = tuple(spline.function(coefficients) for coefficients in shapes_of_modes)
    pairs = Eigenpairs(np.array([4.0, 9.0]), np.zeros((2, 0)), np.zeros(2), functions)

    class Frames:
        def __init__(self, path, spline, *, y):
            self.y, self.seen = y, []
            made.append(self)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def write(self, t):
            largest = np.abs(spline.nodal(self.y)).max(initial=0.0)
            self.seen.append((t, COMM.allreduce(float(largest), op=MPI.MAX)))

    made = []
    monkeypatch.setattr("tigar_x.splines.modes.VTUSeries", Frames)
    write_modes(folder / "modes", spline, pairs)
    np.testing.assert_allclose(made[0].seen, [(2.0, 1.0), (3.0, 1.0)], rtol=1e-9)
    draw(folder / "modes.png", mode_curves(spline, pairs, length="m", samples=5))
    if COMM.rank == 0:
        curves = [line.get_ydata() for line in saved[0].axes[0].get_lines()]
        np.testing.assert_allclose(curves, [np.linspace(0.0, 1.0, 5), np.linspace(1.0, 0.0, 5)], atol=0.15)
        assert [curve[np.abs(curve).argmax()] for curve in curves] == [1.0, 1.0]
        assert any(text.startswith(r"$\omega$ = 3") for text in texts(saved[0]))
    else:
        assert not saved
