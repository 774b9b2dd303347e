"""Inflation of a clamped square plate: large strains of incompressible hyperelastic shells.

The plate [-1, 1]^2 of thickness h lies in the plane x_3 = 0 and is clamped at all edges. A pressure P follows its
normal. So it works on the volume V that the plate encloses with its reference plane, and in equilibrium the elastic
energy is W = int_0^V P dV along the whole path: the check of this demo. Besides, the solution has all symmetries of
the square, and a quarter of it with conditions of symmetry gives the same. Under small pressures it is that of plate
theory, 0.0012653 P 2^4/D high with D = mu h^3/3. Under the full one the plate bends at its edges with radii as small
as h, which takes fine meshes to resolve: with 16, 32, 64 and 128 biquadratic elements a side it is 0.865, 0.890, 0.901
and 0.911 high.

By default the material is neo-Hookean with mu = 1e4, h = 0.03 and P = 5e2, and the plate has 16 x 16 biquadratic
elements with four points through the thickness, as in the demonstration of hyperelastic shells that accompanies
D. Kamensky, doi:10.1016/j.camwa.2020.01.023; `--ramp 1 --step 0.01 --growth 1` takes its 100 equal load steps. Thinning
lets the pressure pass a maximum of about 560, beyond which there is no equilibrium nearby: `SolveError`.
The other material is bovine pericardium of Lee and Sacks under the pressure that closes a heart valve, in centimetres,
grams and seconds. Shells: Kiendl et al., doi:10.1016/j.cma.2015.03.010.
"""

from dataclasses import replace
from functools import partial
from typing import Any

from shnapr.problems.inflation import Inflated, Plate, imbalance
from tigar_x import Colours, Results, VTUSeries, against, draw, family, lines, sampling, scene, script, with_results
from tigar_x.run.convergence import halved, observed_rates
from tigar_x.splines.pictures import Surface

TOY = {"elements": 4, "points": 2, "step": 0.25}
MEASURED = ("height", "volume", "energy")


@with_results
def main(results: Results, plate: Plate, levels: int = 1, step: float = 0.05, growth: float = 1.5) -> dict[str, Any]:
    """Inflate a clamped plate, and compare its energy with the work of the pressure.

    Args:
        levels: number of plates, each of half as many elements as the next, to observe convergence.
        step: first step of the pseudo-time, which ends at 1.
        growth: factor by which an easy step grows, up to twice the first; 1: equal steps.
    """
    sizes, paths, sections, more = halved(plate.elements, levels, multiple=2), [], [], {}
    results.claim()
    for n in sizes:
        inflated = Inflated(replace(plate, elements=n))
        if n == plate.elements:
            series = [partial(VTUSeries, results.out / "plate", inflated.shell.spline, y=inflated.shell.y)]
            more = {"results": results, "series": series, "each": inflated.sections_into(sections)}
        paths.append(inflated.inflate(step=step, growth=growth, **more))
    path, (stretch, thinning) = paths[-1], inflated.at_nodes().T
    if results.viz:
        net, y, ratio = (
            sampling.net(inflated.shell.spline, 33, patch=0),
            inflated.shell.y,
            Colours("thickness by h", "-"),
        )
        shown = scene([Surface.of_net(net.positions(y), net.values(thinning))], length="length", colours=ratio)
        load = {"colours": Colours("pressure", "force/area"), "values": path.history["pressure"]}
        section = family(sections, length="length", coordinates=(0, 2), **load)
        work = {
            f"{n} elements": [p.history[k] for k in ("volume", "pressure")] for n, p in zip(sizes, paths, strict=True)
        }
        curves = lines(work, x=("enclosed volume", "length^3"), y=("pressure", "force/area"))
        draw(results.out / "inflation.png", shown, section, curves, columns=3)
    found = {name: path.final(name) for name in MEASURED}
    found |= {"largest_stretch": stretch.max(), "smallest_thickness_ratio": thinning.min()}
    return results.of_path(
        path,
        errors={"energy_balance": imbalance(path)},
        qoi=against(found, {}),
        levels=[{name: p.final(name) for name in ("pressure", *MEASURED)} for p in paths],
        rates=observed_rates([{name: p.final(name) for name in MEASURED} for p in paths]),
        monitors={"asymmetry": inflated.asymmetry()},
        dofs_shell=inflated.shell.spline.geometry.n * 3,
    )


if __name__ == "__main__":
    script.command_line(main)
