"""Cases of ``stability.py`` whose pressures, starts, energies, meshes, ranks or numbers of steps are extreme."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from load import on_ranks
from stability_runs import TIGHT, Observed, Reports, advance, case, long_advance, released, through_duct
from stability_scenes import box, duct

from coudalfish import (
    CouplingOptions,
)
from tigar_x.run.progress import rss_mib


@case(
    "pressure jump, dt = 0.01/sqrt(jump)",
    "slip after the load change = jump dt/beta within 20 %",
    *((1.0, 0.0, 1e-3), (1e3, 0.1, 1e-3), (1e5, 0.0, 1e-3), (1e5, 0.1, 1e-3), (1e5, 0.1, 0.02)),
    slow=((1.0, 0.1, 1e-3), (1e5, 0.0, 0.02)),
)
def jump(value: tuple[float, float, float]) -> tuple[Reports, Observed]:
    """Value: jump, bow of the sheet, scale_c. A smooth load of 60 steps leaves little of the springs' ringing."""
    load, bow, scale_c = value
    scene = duct(CouplingOptions(scale_c=scale_c), dt=0.01 / load**0.5, jump=0.0, bow=bow)
    reports, observed = loaded(scene, load)
    return reports, {**observed, "slip ratio": reports[-1].slip_ratio}


def loaded(scene: Any, load: float) -> tuple[Reports, Observed]:
    """A smooth load, and what the sheet in the duct does, relative to the law of its springs and to the load."""
    reports, observed, _ = through_duct(scene, 80, jump=load, ramp=60)
    law = load * scene.fsi.timeInt_f.step_size / reports[-1].penalty
    return reports, {
        "slip/law": observed["slip"] / law,
        "outflow/law": observed["outflow"] / law,
        "largest speed/sqrt(jump)": observed["largest speed"] / load**0.5,
    }


@case(
    "pressure jump at rest, dt = 0.01, beta = 5e3",
    "spurious velocity proportional to the jump",
    *(1.0, 1e2, 1e3, 1e4, 1e5),
)
def spurious(load: float) -> tuple[Reports, Observed]:
    scene = duct(CouplingOptions(scale_c=1e-3, penalty=5e3), jump=0.0, bow=0.1)
    reports, observed, _ = through_duct(scene, 30, jump=load, ramp=20)
    return reports, {
        "largest speed/jump": observed["largest speed"] / load,
        "slip/law": observed["slip"] / (load * 0.01 / 5e3),
        "outflow/jump": observed["outflow"] / load,
        "slip ratio": reports[-1].slip_ratio,
    }


@case("pressure jump, dt = 0.01, defaults", "finite, and a warning that beta is too small", *(1e2, 1e4, 1e5))
def jump_too_large(load: float) -> tuple[Reports, Observed]:
    reports, observed, _ = through_duct(duct(jump=load), 20, jump=load)
    return reports, {"slip rate": observed["slip rate"], "slip ratio": reports[-1].slip_ratio}


@case(
    "leak with r > 0",
    "steady leak = r jump/((1 + r) beta) within 10 %",
    *((0.1, 1.0), (0.1, 1e3), (1e-2, 1.0)),
    slow=((1e-2, 1e3), (1e-3, 1.0)),
)
def leak(value: tuple[float, float]) -> tuple[Reports, Observed]:
    """Value: r, jump."""
    r, load = value
    beta = 5.0 * load**0.5
    options = CouplingOptions(scale_c=1e-3, penalty=beta, relaxation=r, relaxation_mode="uniform")
    steps = {0.1: 110, 1e-2: 380}.get(r, 1500)
    scene = duct(options, dt=0.01 / load**0.5, jump=0.0, bow=0.1)
    reports, observed, _ = through_duct(scene, steps, jump=load, ramp=60)
    law = r * load / ((1.0 + r) * beta)
    return reports, {"leak/law": observed["slip rate"] / law, "outflow/law": observed["outflow rate"] / law}


@case(
    "impulsive load 2e4, then -1e5 in one step",
    "finite in at most 100 passes",
    *("as published", "default penalty", "dt x 20", "light", "limp"),
)
def impulsive(what: str) -> tuple[Reports, Observed]:
    valve = {"E": 1e7, "thickness": 0.04, "rho_s": 1.0} | ({"rho_s": 1e-6} if what == "light" else {})
    valve |= {"E": 1e4} if what == "limp" else {}
    published = CouplingOptions(penalty=500.0, relaxation=1e-5, relaxation_mode="uniform", scale_c=1e-3)
    options = CouplingOptions(scale_c=1e-3) if what == "default penalty" else published
    dt = 5e-5 * (20.0 if what == "dt x 20" else 1.0)
    scene = duct(options, mu=0.03, dt=dt, jump=0.0, flexible=True, degree=2, **valve)

    def load(n: int) -> None:
        scene.load.value[0] = 2e4 if n < 15 else -1e5

    reports = advance(scene.fsi, 30, load)
    return reports, {
        "passes at the change": float(reports[15].passes),
        "largest speed": scene.fsi.fluid.speed(),
        "deflection": float(np.abs(scene.fsi.timeInt_sh.x.x.array).max()),
        "second attempts": float(sum(report.attempts > 1 for report in reports)),
    }


@case("energy: backward Euler, mu", "never grows", *(0.01, 1e-4, 1e-6))
def energy_backward_euler(mu: float) -> tuple[Reports, Observed]:
    return released(60, mu=mu)


@case("energy: generalized-alpha, rho_infinity", "bounded", *(0.0, 0.5, 1.0))
def energy_generalized_alpha(rho: float) -> tuple[Reports, Observed]:
    return released(60, mu=1e-4, rho_infinity=rho)


@case(
    "point spacing / h",
    "a warning beyond 0.75, and the leak that follows",
    *(0.1, 0.5, 0.7, 1.0, 1.5, 3.0),
)
def spacing(ratio: float) -> tuple[Reports, Observed]:
    scene = duct(CouplingOptions(scale_c=1e-3), jump=0.0, bow=0.05, elements=round(12 / ratio))
    reports, observed, rates = through_duct(scene, 100, ramp=60)
    law = 0.01 / reports[-1].penalty
    return reports, {
        "outflow/law": observed["outflow"] / law,
        "slip/law": observed["slip"] / law,
        "outflow rate": float(np.mean(rates[-40:])),
    }


@case(
    "rotated and translated axes (angle, shift)",
    "same answer to solver tolerance",
    *((0.7, 0.0, 0.0), (2.1, 3.0, -5.0), (0.0, 100.0, -30.0)),
)
def rotated(value: tuple[float, float, float]) -> tuple[Reports, Observed]:
    angle, *shift = value
    results = []
    for position in ({}, {"angle": angle, "shift": tuple(shift)}):
        scene = box(TIGHT, prestress=1.0, **position)
        reports = advance(scene.fsi, 10)
        nodal = scene.fsi.timeInt_f.x.x.array.reshape(-1, 3)
        y = scene.fsi.spline_sh.nodal(scene.fsi.timeInt_sh.x)
        results.append((nodal[:, :2] @ scene.rotation, nodal[:, 2], y @ scene.rotation, scene.fsi.lam))
    names = ("u differs by", "p differs by", "y differs by", "multiplier differs by")
    return reports, {
        name: float(np.abs(b - a).max() / np.abs(a).max()) for name, a, b in zip(names, *results, strict=True)
    }


@case(
    "free sheet in uniform flow, direction",
    "translates exactly; p constant and multiplier 0 to solver tolerance",
    *(f"{45 * k} degrees" for k in range(8)),
)
def uniform(direction: str) -> tuple[Reports, Observed]:
    angle = math.radians(float(direction.split()[0]))
    velocity = (0.3 * math.cos(angle), 0.3 * math.sin(angle))
    scene = box(TIGHT, velocity=velocity, free=True, dt=0.1, rho_infinity=0.5)
    reports = advance(scene.fsi, 5)
    y, w = scene.fsi.spline_sh.nodal(scene.fsi.timeInt_sh.x), scene.fsi.timeInt_f.x.x.array.reshape(-1, 3)
    return reports, {
        "translation off by": float(np.abs(y - 0.5 * np.array(velocity)).max()),
        "velocity off by": float(np.abs(w[:, :2] - velocity).max()),
        "pressure varies by": float(np.ptp(w[:, 2])),
        "multiplier": float(np.abs(scene.fsi.lam).max()),
    }


@case(
    "Taylor-Hood elements in the duct, jump and grad-div",
    "slip after the load change = jump dt/beta within 20 %",
    *((1.0, 1.0), (1.0, 100.0), (1e5, 100.0)),
)
def taylor_hood(value: tuple[float, float]) -> tuple[Reports, Observed]:
    """Value: jump, grad-div coefficient over sqrt(rho jump) times length."""
    load, grad_div = value
    scene = duct(n=6, dt=0.01 / load**0.5, jump=0.0, bow=0.1, grad_div=grad_div * load**0.5)
    return loaded(scene, load)


@case("ranks", "same errors as on one rank to 1e-8", slow=(2, 3))
def ranks(n: int) -> tuple[Reports, Observed]:
    one, many = (errors_on(size) for size in (1, n))
    return [], {f"{name} differs by": abs(many[name] - one[name]) / one[name] for name in one}


def errors_on(n: int) -> Observed:
    """Errors of the manufactured problem on n processes, with direct solves and tight block tolerances."""
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); from mpi4py import MPI; import json; "
    code += "import stability_runs as s; e = s.manufactured(2, s.TIGHT)[1]; "
    code += "print(json.dumps(e)) if not MPI.COMM_WORLD.rank else None"
    return dict(on_ranks(n, "-c", code))


@case(
    "long run: steps, sheet, r",
    "memory flat, multiplier does not drift",
    *((600, "straight", 0.0), (600, "arc", 0.0)),
    slow=((10_000, "straight", 0.0), (10_000, "arc", 0.0), (10_000, "arc", 1e-2), (10_000, "elastic", 0.0)),
)
def long_run(value: tuple[int, str, float]) -> tuple[Reports, Observed]:
    """A duct under a steady jump: in the second half of the run, with the springs at rest, nothing should change."""
    steps, form, r = value
    shape: dict[str, Any] = {"arc": {"bow": 0.1}, "elastic": {"flexible": True, "prestress": 10.0}}.get(form, {})
    scene = duct(CouplingOptions(penalty=50.0, relaxation=r, relaxation_mode="uniform"), n=4, jump=0.0, **shape)
    fsi, W = scene.fsi, scene.fsi.shell.quadrature.weights
    reports, *_ = through_duct(scene, 100, ramp=60)
    reports = long_advance(fsi, steps // 2 - 100)
    lam, memory = fsi.lam.copy(), rss_mib()
    reports = long_advance(fsi, steps // 2)
    drift = fsi.lam - lam
    return reports, {
        "memory grows by [MiB]": rss_mib() - memory,
        "multiplier drifts by": float(np.abs(drift).max()),
        "its mean by": abs(float(drift @ W)) / scene.length,
        "slip rms": reports[-1].monitors.normal_slip_rms if reports[-1].monitors else math.nan,
        "largest speed": fsi.fluid.speed(),
    }
