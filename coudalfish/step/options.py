"""Options of the coupling, one documented default each."""

from dataclasses import dataclass, fields, replace
from typing import Any, Literal

from tigar_x import checks


@dataclass(frozen=True)
class PenaltyRule:
    """Penalty by rule, ``beta = C_1 mu/h + C_2 rho h/dt``.

    The first term is the published guideline (doi:10.1016/j.camwa.2020.01.023), the second keeps the sheet tight when
    viscosity vanishes.

    Attributes:
        C_1: factor of mu/h, >= 0.
        C_2: factor of rho h/dt, >= 0.

    Raises:
        ValueError: a factor is negative, or both vanish.
    """

    C_1: float
    C_2: float

    def __post_init__(self) -> None:
        checks.not_negative("C_1", self.C_1)
        checks.not_negative("C_2", self.C_2)
        if self.C_1 == 0.0 == self.C_2:
            raise ValueError("C_1 = C_2 = 0: at least one factor > 0 is required")

    def __call__(self, *, mu: float, rho: float, h: float, dt: float) -> float:
        """The penalty; unit: force time/length^3."""
        return self.C_1 * mu / h + self.C_2 * rho * h / dt


@dataclass(frozen=True)
class CouplingOptions:
    """How fluid and shell are coupled.

    Attributes:
        penalty: beta as a number (unit: force time/length^3) or a rule.
        multiplier: "lagged" is that of the step before and updated after each, "converged" an unknown of the step, of
            few functions on the shell, which fluid and shell are solved with at once; a step in which that fails falls
            back to a lagged one that is smoothed.
        multiplier_size: size of the cells on the shell whose hat functions make a converged multiplier, relative to
            the fluid's cells.
        multiplier_direction: "normal", or a converged multiplier may be a "vector", for fluids whose velocity may
            have a kink at the shell; it locks others.
        relaxation: r >= 0 in the update of a lagged multiplier; 0: none, with which patterns of the multiplier that no
            mesh of the fluid sees grow from step to step, see docs/stability.md.
        relaxation_mode: "smoothed" damps by r only what the multiplier differs by from its means over the vertices of
            the fluid's mesh, which does not leak: r may be 0.1 to 1; "uniform" damps all of it and leaks.
        trace: what the shell's points see of the fluid's velocity: that at the "nodes" where they are, or the "exact"
            average over their hat functions on a curve in the plane, which also gives them their areas. A surface in
            space that divides cells has that average whatever is chosen here.
        scale_m: factor of tau_M in the band around the surface of plain fields, in (0, 1].
        scale_c: divisor of tau_C there, in (0, 1].
        fluid_tangent: penalty tangent of the fluid, "lumped" (its row sums) or "consistent".
        normal: shell normals from the "predictor" of the step or from the present "iterate".
        stopping: "before_solve" tests both residuals before a pass solves; "published" tests after both solves.
        tangent_update: assemble and factor tangents once per "step" or in every "pass".
        block_rtol: accepted residual of each block relative to its first one in the step or, unless the stopping is
            "published", to the coupling forces in it where these are smaller.
        block_atol: accepted residual of each block relative to the size of the terms that balance in it, which is
            independent of units; 0: rounding alone.
        max_passes: passes after which an attempt has failed.
        acceleration: depth of the Anderson acceleration of the shell's iterates; 0: none.
        accelerate_after: passes without acceleration; those after it also use the consistent tangent.
        second_attempt: whether a step that does not converge is attempted once more with under-relaxation, acceleration
            from the start and tangents assembled in every pass.

    Raises:
        ValueError: an option is out of range.
    """

    penalty: float | PenaltyRule = PenaltyRule(2.0, 0.5)
    multiplier: Literal["lagged", "converged"] = "lagged"
    multiplier_size: float = 2.5
    multiplier_direction: Literal["normal", "vector"] = "normal"
    relaxation: float = 0.2
    relaxation_mode: Literal["uniform", "smoothed"] = "smoothed"
    trace: Literal["nodes", "exact"] = "nodes"
    scale_m: float = 1e-3
    scale_c: float = 0.02
    fluid_tangent: Literal["lumped", "consistent"] = "lumped"
    normal: Literal["predictor", "iterate"] = "predictor"
    stopping: Literal["before_solve", "published"] = "before_solve"
    tangent_update: Literal["step", "pass"] = "step"
    block_rtol: float = 1e-2
    block_atol: float = 1e-8
    max_passes: int = 100
    acceleration: int = 5
    accelerate_after: int = 6
    second_attempt: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.penalty, PenaltyRule):
            checks.positive("penalty", self.penalty)
        checks.choice("multiplier", self.multiplier, ("lagged", "converged"))
        checks.positive("multiplier_size", self.multiplier_size)
        checks.choice("multiplier_direction", self.multiplier_direction, ("normal", "vector"))
        if (self.multiplier, self.multiplier_direction) == ("lagged", "vector"):
            raise ValueError("multiplier = 'lagged', multiplier_direction = 'vector': 'normal' is required")
        checks.not_negative("relaxation", self.relaxation)
        checks.choice("relaxation_mode", self.relaxation_mode, ("uniform", "smoothed"))
        checks.choice("trace", self.trace, ("nodes", "exact"))
        for name in ("scale_m", "scale_c"):
            checks.within(name, checks.positive(name, getattr(self, name)), 0.0, 1.0)
        checks.choice("fluid_tangent", self.fluid_tangent, ("lumped", "consistent"))
        checks.choice("normal", self.normal, ("predictor", "iterate"))
        checks.choice("stopping", self.stopping, ("before_solve", "published"))
        checks.choice("tangent_update", self.tangent_update, ("step", "pass"))
        checks.not_negative("block_rtol", self.block_rtol)
        checks.not_negative("block_atol", self.block_atol)
        checks.whole("max_passes", self.max_passes, 1)
        checks.flag("second_attempt", self.second_attempt)
        checks.whole("acceleration", self.acceleration, 0)
        checks.whole("accelerate_after", self.accelerate_after, 0)
        if self.multiplier == "converged" and self.stopping == "published":
            raise ValueError("multiplier = 'converged', stopping = 'published': stopping 'before_solve' is required")

    def with_(self, **changes: Any) -> "CouplingOptions":
        """The same options but for some.

        Args:
            changes: options by name.

        Raises:
            TypeError: there is no such option.
            ValueError: an option is out of range.
        """
        names = [field.name for field in fields(self)]
        if unknown := sorted(set(changes) - set(names)):
            raise TypeError(f"{unknown[0]} is no option of the coupling: one of {', '.join(names)} is required")
        return replace(self, **changes)

    @classmethod
    def converged(cls, **changes: Any) -> "CouplingOptions":
        """A multiplier that is converged in every step, with a penalty that knows neither the time step nor inertia.

        Frequencies of light shells are right at any time step, and sheets do not leak. With ``fluid_tangent =
        "consistent"``, in the plane also ``trace = "exact"``, for ``Flow(..., immersed="jump")``.

        Args:
            changes: other options.
        """
        return cls(multiplier="converged", penalty=PenaltyRule(10.0, 0.0)).with_(**changes)

    @classmethod
    def sharp(cls, **changes: Any) -> "CouplingOptions":
        """For flows whose fields differ on both sides of the surface, ``Flow(..., immersed="jump and kink")``.

        Args:
            changes: other options.
        """
        kept = {"trace": "exact", "multiplier_direction": "vector", "fluid_tangent": "consistent"}
        return cls.converged(**kept | changes)

    @classmethod
    def reference(cls, **changes: Any) -> "CouplingOptions":
        """The published algorithm (doi:10.1016/j.camwa.2020.01.023): its equations and its stopping test.

        Its fields are those of ``Flow(..., immersed="plain")``.

        Args:
            changes: other options, such as the penalty of a published run.
        """
        return cls(
            penalty=PenaltyRule(1.0, 0.0),
            relaxation=0.0,
            relaxation_mode="uniform",
            scale_m=1e-3,
            scale_c=1e-3,
            fluid_tangent="lumped",
            normal="iterate",
            stopping="published",
            block_rtol=1e-3,
            block_atol=0.0,
            acceleration=0,
            second_attempt=False,
        ).with_(**changes)
