"""Time integration: generalized-alpha, backward Euler and pseudo-time for load steps.

A scheme is data (:class:`Scheme`), the stepper has one verb (:meth:`TimeIntegrator.advance`). Sources: Jansen, Whiting
and Hulbert, doi:10.1016/S0045-7825(00)00203-6 (first order); Chung and Hulbert, doi:10.1115/1.2900803 (second order).

With x the unknown x_{n+1}, the rates at the end of the step are

    x' = a0 (x - x_n)/dt + a1 x'_n + a2 dt x''_n,        x'' = b0 (x' - x'_n)/dt + b1 x''_n,

and the equation is imposed at ``x_alpha = alpha_f x + (1 - alpha_f) x_n`` with x'_alpha (and x''_alpha) alike; external
data belong to ``t_alpha = t_n + alpha_f dt``.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.schemes import Scheme, require_scheme


class TimeIntegrator:
    """Steps one unknown through time and owns its clock.

    The expressions ``x_alpha``, ``xdot_alpha`` and ``xddot_alpha`` go into forms; all coefficients and times are
    dolfinx Constants, so that another step size or scheme of the same order compiles nothing.

    Args:
        x: the unknown x_{n+1}; its present value is the initial one.
        dt: step size; unit: time.
        scheme: from :func:`~tigar_x.fem.schemes.generalized_alpha` or :func:`~tigar_x.fem.schemes.backward_euler`.
        t: initial time.
        xdot: initial rate; None: zero.
        xddot: initial second rate; None: zero.
        algebraic: components of x that are not integrated, such as a pressure: they enter ``x_alpha`` as they are, and
            approximate the value at ``t_alpha`` (Liu et al., arXiv:2002.01098).

    Attributes:
        x_old: x_n.
        xdot_old: x'_n.
        xddot_old: x''_n (second order only).
        t: Constant, end t_{n+1} of the step in progress.
        t_alpha: Constant, t_n + alpha_f dt.
        dt: Constant, step size.
        in_step: whether a step has been predicted and not been accepted or given up; what belongs to the level of the
            equations has a meaning only then.
        partner: integrator of the other side of a coupling, whose coupler steps both; None: it has none.
        algebraic: as given.

    Raises:
        ValueError: dt is not positive, or a component does not exist.
    """

    def __init__(
        self,
        x: fem.Function,
        dt: float,
        scheme: Scheme,
        *,
        t: float = 0.0,
        xdot: fem.Function | None = None,
        xddot: fem.Function | None = None,
        algebraic: Sequence[int] = (),
    ) -> None:
        require_scheme("scheme", scheme)
        self.scheme = scheme
        self.x = checks.kind("x", x, fem.Function, "the unknown function")
        V = x.function_space
        self.x_old = fem.Function(V, name=f"{x.name}_old")
        self.xdot_old = fem.Function(V, name=f"{x.name}_dot_old")
        self.x_old.x.array[:] = x.x.array
        if xdot is not None:
            self.xdot_old.x.array[:] = xdot.x.array
        if scheme.order == 2:
            self.xddot_old = fem.Function(V, name=f"{x.name}_ddot_old")
            self.xddot_old.x.array[:] = 0.0 if xddot is None else xddot.x.array
        for component in algebraic:
            checks.choice("algebraic", component, tuple(range(x.ufl_shape[0])) if x.ufl_shape else ())
        self.algebraic = frozenset(algebraic)
        self.in_step = False
        self.partner: TimeIntegrator | None = None

        names = ("alpha_f", "alpha_m", "a0", "a1", "a2", "b0", "b1")
        self._c = {name: compat.Constant(V.mesh, float(getattr(scheme, name))) for name in names}
        self._t_n = checks.finite("t", t)
        self.dt = compat.Constant(V.mesh, checks.positive("dt", dt))
        self.t = compat.Constant(V.mesh, self._t_n)
        self.t_alpha = compat.Constant(V.mesh, self._t_n)
        self._set_clock()

    def __repr__(self) -> str:
        c, x = self.scheme, f"{self.x.name} of {compat.unknowns(self.x.function_space)} unknowns"
        scheme = f"order {c.order}, alpha_f = {c.alpha_f:g}, alpha_m = {c.alpha_m:g}"
        return f"TimeIntegrator({x}, t = {self.time:g}, dt = {self.step_size:g}, {scheme})"

    def _set_clock(self) -> None:
        step = self.step_size
        self.t.value = self._t_n + step
        self.t_alpha.value = self._t_n + float(self._c["alpha_f"].value) * step

    @property
    def step_size(self) -> float:
        """Size of the step in progress; assign to change it. Unit: time."""
        return float(self.dt.value)

    @step_size.setter
    def step_size(self, value: float) -> None:
        self.dt.value = checks.positive("dt", value)
        self._set_clock()

    @property
    def time(self) -> float:
        """Time t_n of the last accepted state."""
        return self._t_n

    # -- expressions for forms ----------------------------------------------------------------------------------------

    @property
    def xdot(self) -> Any:
        """Rate at the end of the step as UFL expression."""
        c = self._c
        rate = c["a0"] / self.dt * (self.x - self.x_old) + c["a1"] * self.xdot_old
        return rate + c["a2"] * self.dt * self.xddot_old if self.scheme.order == 2 else rate

    @property
    def x_alpha(self) -> Any:
        """Unknown at the intermediate level; algebraic components are those of x itself."""
        mean = self.at_level(self.x)
        if not self.algebraic:
            return mean
        return ufl.as_vector([self.x[i] if i in self.algebraic else mean[i] for i in range(self.x.ufl_shape[0])])

    @property
    def xdot_alpha(self) -> Any:
        """First rate at the intermediate level (entries of algebraic components have no meaning)."""
        a = self._c["alpha_m" if self.scheme.order == 1 else "alpha_f"]
        return a * self.xdot + (1 - a) * self.xdot_old

    @property
    def xddot_alpha(self) -> Any:
        """Second rate at the intermediate level."""
        if self.scheme.order == 1:
            raise AttributeError("a first-order scheme has no second rate")
        c = self._c
        a = c["alpha_m"]
        xddot = c["b0"] / self.dt * (self.xdot - self.xdot_old) + c["b1"] * self.xddot_old
        return a * xddot + (1 - a) * self.xddot_old

    def at_level(self, x: Any) -> Any:
        """Any expression of x_{n+1} brought to the intermediate level with x_n.

        Args:
            x: UFL expression of the unknown's shape.
        """
        a = self._c["alpha_f"]
        return a * x + (1 - a) * self.x_old

    def x_from_rate(self, xdot: Any) -> Any:
        """The x_{n+1} that has a given rate at the end of the step, as UFL expression.

        Args:
            xdot: rate, UFL expression of the unknown's shape.
        """
        c = self._c
        slope = xdot - c["a1"] * self.xdot_old
        slope = slope - c["a2"] * self.dt * self.xddot_old if self.scheme.order == 2 else slope
        return self.x_old + self.dt / c["a0"] * slope

    def rates(self) -> tuple[FloatArray, ...]:
        """First (and second) rate at the end of the step, local dofs with ghosts."""
        s, h = self.scheme, self.step_size
        x, x_n, v_n = (f.x.array for f in (self.x, self.x_old, self.xdot_old))
        xdot = s.a0 / h * (x - x_n) + s.a1 * v_n
        if s.order == 1:
            return (xdot,)
        xdot += s.a2 * h * self.xddot_old.x.array
        return xdot, s.b0 / h * (xdot - v_n) + s.b1 * self.xddot_old.x.array

    def x_alpha_array(self) -> FloatArray:
        """``alpha_f x + (1 - alpha_f) x_n``, local dofs with ghosts."""
        a = self.scheme.alpha_f
        return a * self.x.x.array + (1.0 - a) * self.x_old.x.array

    def xdot_alpha_array(self) -> FloatArray:
        """First rate at the intermediate level, local dofs with ghosts."""
        a = self.scheme.alpha_m if self.scheme.order == 1 else self.scheme.alpha_f
        return a * self.rates()[0] + (1.0 - a) * self.xdot_old.x.array

    def x_from_rate_array(self, xdot: FloatArray, dofs: IntArray) -> FloatArray:
        """:meth:`x_from_rate` at some dofs.

        Args:
            xdot: rates, of any shape.
            dofs: local dofs, of the same shape.
        """
        s, h = self.scheme, self.step_size
        slope = xdot - s.a1 * self.xdot_old.x.array[dofs]
        if s.order == 2:
            slope -= s.a2 * h * self.xddot_old.x.array[dofs]
        return np.asarray(self.x_old.x.array[dofs] + h / s.a0 * slope)

    @property
    def x_factor(self) -> float:
        """Derivative of x_alpha with respect to x."""
        return self.scheme.alpha_f

    @property
    def xdot_factor(self) -> float:
        """Derivative of x'_alpha with respect to x; unit: 1/time."""
        s = self.scheme
        return (s.alpha_m if s.order == 1 else s.alpha_f) * s.a0 / self.step_size

    def predict(self) -> None:
        """Same-velocity predictor: x_n in first-order systems, the x that keeps x' = x'_n in second-order ones."""
        self.in_step = True
        self.x.x.array[:] = self.x_old.x.array
        s, h = self.scheme, self.step_size
        if s.order == 2:
            slope = (1.0 - s.a1) * self.xdot_old.x.array - s.a2 * h * self.xddot_old.x.array
            self.x.x.array[:] += h / s.a0 * slope

    @property
    def unknowns(self) -> tuple[fem.Function, ...]:
        """All that a step solves for."""
        return (self.x,)

    @property
    def state(self) -> dict[str, fem.Function]:
        """The last accepted state by name, x_n and its rates; with the clock it is what further steps follow from."""
        rates = {"xdot": self.xdot_old} | ({"xddot": self.xddot_old} if self.scheme.order == 2 else {})
        return {"x": self.x_old, **rates}

    def resume(self, t: float, dt: float) -> None:
        """Go on from what the functions of :attr:`state` hold now.

        Args:
            t: time of that state.
            dt: size of the step in progress; unit: time.

        Raises:
            ValueError: t is not finite, or dt not positive.
        """
        self._t_n, self.dt.value = checks.finite("t", t), checks.positive("dt", dt)
        self._set_clock()
        self.restore()

    def restore(self) -> None:
        """Put x back to the last accepted state; the clock has not moved."""
        self.in_step = False
        self.x.x.array[:] = self.x_old.x.array

    def advance(self) -> None:
        """Accept x as the state at t_{n+1} and move the clock."""
        rates, self.in_step = self.rates(), False
        self.x_old.x.array[:] = self.x.x.array
        self.xdot_old.x.array[:] = rates[0]
        if self.scheme.order == 2:
            self.xddot_old.x.array[:] = rates[1]
        self._t_n += self.step_size
        self._set_clock()

    def initial_form(self, residual: ufl.Form, *others: "TimeIntegrator") -> tuple[ufl.Form, fem.Function]:
        """What a consistent start has to solve.

        With a zero initial rate a scheme with rho_infinity < 1 is only first-order accurate. The returned form is the
        given residual at t_n as a function of the highest rate and of the algebraic components, which the equations
        must determine (a stabilised flow does; a constraint without the algebraic component, as in Taylor-Hood
        elements, does not). Solve it, then hand its unknown to :meth:`start`.

        Args:
            residual: residual built from this integrator's expressions.
            others: integrators of other fields in the residual, which are taken at t_n as they are.

        Returns:
            The residual at t_n and its unknown.
        """
        V = self.x.function_space
        unknown = fem.Function(V, name="initial")
        state: Any = self.x_old
        if self.algebraic:
            size = self.x.ufl_shape[0]
            state = ufl.as_vector([(unknown if i in self.algebraic else self.x_old)[i] for i in range(size)])
        highest = self.xdot_old if self.scheme.order == 1 else self.xddot_old
        zero = ufl.as_ufl(0.0)
        at_t_n: dict[Any, Any] = {self.x: state, highest: unknown, self.t_alpha: self.t - self.dt}
        for integrator in (self, *others):
            at_t_n |= {integrator._c["alpha_f"]: zero, integrator._c["alpha_m"]: zero}
        return ufl.replace(residual, at_t_n), unknown

    def start(self, unknown: fem.Function) -> None:
        """Take the solution of :meth:`initial_form` as the initial rate and algebraic components."""
        highest = self.xdot_old if self.scheme.order == 1 else self.xddot_old
        highest.x.array[:] = unknown.x.array
        for component in self.algebraic:
            _, dofs = compat.component_space(self.x.function_space, component)
            for f in (self.x, self.x_old):
                f.x.array[dofs] = unknown.x.array[dofs]
            highest.x.array[dofs] = 0.0


class LoadStepper:
    """Pseudo-time of a static problem; :func:`tigar_x.fem.load_stepping.follow_load` chooses its steps.

    Args:
        x: the unknown.
        dt: load step.
        t: initial pseudo-time.

    Attributes:
        x: the unknown.
        t: Constant, pseudo-time of the step in progress.

    Raises:
        ValueError: dt is not positive.
    """

    def __init__(self, x: fem.Function, dt: float, *, t: float = 0.0) -> None:
        self.x = checks.kind("x", x, fem.Function, "the unknown function")
        self._dt = checks.positive("dt", dt)
        self._t_n = checks.finite("t", t)
        self.t = compat.Constant(x.function_space.mesh, self._t_n + self._dt)

    @property
    def time(self) -> float:
        """Pseudo-time of the last accepted state."""
        return self._t_n

    @property
    def step_size(self) -> float:
        """Size of the step in progress; assign to change it."""
        return self._dt

    @step_size.setter
    def step_size(self, value: float) -> None:
        self._dt = checks.positive("dt", value)
        self.t.value = self._t_n + self._dt

    def resume(self, t: float) -> None:
        """Take x as the state at another pseudo-time, which ``t`` is then as well, as after a load was followed."""
        self._t_n = checks.finite("t", t)
        self.t.value = self._t_n

    def advance(self) -> None:
        """Accept x as the state at t and go on to the next load step."""
        self._t_n = float(self.t.value)
        self.t.value = self._t_n + self._dt
