"""Runs of ``valve_2d.py``: presets, meshes and time steps, and settings one at a time."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

from coudalfish import CouplingOptions, PenaltyRule
from tigar_x.fem.linear import LinearSolver, direct, gmres_ilu

PLAIN = CouplingOptions()
REFERENCE = replace(CouplingOptions.reference(), block_rtol=1e-2)
SMOOTHED = replace(PLAIN, relaxation=0.5)
TIGHT = replace(PLAIN, penalty=PenaltyRule(2.0, 2.0), block_rtol=0.1)


@dataclass(frozen=True)
class Case:
    """A run: what it is called and what it is built with.

    Attributes:
        setting: name within its study.
        dim: dimension of space.
        elements: across the channel.
        options: of the coupling.
        preset: of the demo, for what else belongs to the options.
        mirrored: whether the cells mirror each other.
        dt_factor: time step relative to the published one.
        leaflet_elements: of each leaflet.
        degree: of the leaflets.
        invariant_metric: of the stabilisation.
        solver: of the flow; None: by size.
        rho_infinity: of the time integration.
    """

    setting: str
    dim: int = 2
    elements: int = 24
    options: CouplingOptions = PLAIN
    preset: str = "plain"
    mirrored: bool = True
    dt_factor: float = 1.0
    leaflet_elements: int = 16
    degree: int = 2
    invariant_metric: bool = False
    solver: LinearSolver | None = None
    rho_infinity: float = 0.0

    @property
    def cost(self) -> float:
        """Rough size of the run."""
        return float(self.elements**3.3) * (6 if self.dim == 3 else 1) / self.dt_factor


def finest_case(elements: int) -> Case:
    """The run that errors refer to."""
    return Case(f"2D plain with C_2 = 2, {elements}", 2, elements, TIGHT, leaflet_elements=32)


def options_studies(elements: int) -> dict[str, list[Case]]:
    """Settings with plain fields, one at a time."""

    def varied(name: str, values: Iterable[Any], make: Callable[[Any], CouplingOptions]) -> list[Case]:
        return [Case(f"{name} {value}", elements=elements, options=make(value)) for value in values]

    def cases(**settings: dict[str, Any]) -> list[Case]:
        return [Case(name.replace("_", " "), elements=elements, **what) for name, what in settings.items()]

    d = PLAIN
    return {
        "plain": cases(plain={}),
        "C_1": varied("C_1", (0.5, 1.0, 4.0, 8.0), lambda c: replace(d, penalty=PenaltyRule(c, 0.5))),
        "C_2": varied("C_2", (0.0, 0.1, 1.0, 2.0, 4.0), lambda c: replace(d, penalty=PenaltyRule(2.0, c))),
        "scale_c": varied("scale_c", (1.0, 0.1, 0.01, 0.001), lambda s: replace(d, scale_c=s)),
        "scale_m": varied("scale_m", (1.0, 0.1, 0.01, 0.0001), lambda s: replace(d, scale_m=s)),
        "relaxation": [
            *varied("r", (0.0, 1e-5, 1e-3, 1e-2), lambda r: replace(d, relaxation=r, relaxation_mode="uniform")),
            *varied("smoothed r", (0.1, 0.5, 2.0), lambda r: replace(d, relaxation=r)),
        ],
        "block_rtol": [
            *varied("block_rtol", (1e-1, 1e-3), lambda r: replace(d, block_rtol=r)),
            Case("block_rtol 0.1 and C_2 2.0", elements=elements, options=TIGHT),
            Case("block_rtol 0.1 and smoothed r 0.5", elements=elements, options=replace(SMOOTHED, block_rtol=0.1)),
        ],
        "block iteration": [
            Case("consistent tangent", elements=elements, options=replace(d, fluid_tangent="consistent")),
            Case("normal of the iterate", elements=elements, options=replace(d, normal="iterate")),
            Case("tangent in every pass", elements=elements, options=replace(d, tangent_update="pass")),
            Case("published stopping", elements=elements, options=replace(d, stopping="published")),
        ],
        "solver": [
            Case("MUMPS", elements=elements, solver=direct()),
            *(Case(f"ILU(1), rtol {r:g}", elements=elements, solver=gmres_ilu(1, rtol=r)) for r in (1e-4, 1e-6)),
            Case("ILU(2), rtol 1e-08", elements=elements, solver=gmres_ilu(2)),
        ],
        "discretisation": cases(
            leaflet_elements_8={"leaflet_elements": 8},
            leaflet_elements_32={"leaflet_elements": 32},
            degree_3={"degree": 3},
            published_mesh={"mirrored": False},
            invariant_metric={"invariant_metric": True},
            published_mesh_and_invariant_metric={"mirrored": False, "invariant_metric": True},
            rho_infinity_0_5={"rho_infinity": 0.5},
        ),
    }


def mesh_study(dim: int, elements: Iterable[int]) -> list[Case]:
    """Presets on meshes; the reference preset has the published mesh."""
    cases = []
    for n in elements:
        cases.append(Case(f"{dim}D reference, {n}", dim, n, REFERENCE, mirrored=False))
        cases.append(Case(f"{dim}D plain, {n}", dim, n))
        if dim == 2:
            cases.append(Case(f"{dim}D plain, published mesh, {n}", dim, n, mirrored=False))
            cases.append(Case(f"{dim}D plain, smoothed multiplier, {n}", dim, n, SMOOTHED))
    return cases


def sides_study(elements: Iterable[int], factors: Iterable[float]) -> list[Case]:
    """Multipliers and fields on meshes, and with several time steps on the first one."""
    chosen, factors = list(elements), list(factors)
    settings = {
        "plain": (PLAIN, "plain"),
        "not relaxed": (replace(PLAIN, relaxation=0.0), "plain"),
        "r = 0.5": (SMOOTHED, "plain"),
        "converged": (CouplingOptions.converged(), "plain"),
        "sharp": (CouplingOptions.sharp(), "sharp"),
    }
    runs = [(n, 1.0) for n in chosen] + [(chosen[0], factor) for factor in factors]
    return [
        Case(f"{name}, {n}, dt x {factor:g}", elements=n, options=options, preset=preset, dt_factor=factor)
        for n, factor in runs
        for name, (options, preset) in settings.items()
    ]


def step_study(elements: int, factors: Iterable[float]) -> list[Case]:
    """Presets with several time steps."""
    presets = (("plain", PLAIN, True), ("reference", REFERENCE, False))
    return [
        Case(f"{name}, {elements}, dt x {factor:g}", 2, elements, options, mirrored=mirrored, dt_factor=factor)
        for name, options, mirrored in presets
        for factor in factors
    ]
