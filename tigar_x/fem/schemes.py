"""One-step schemes in time as data.

Sources: Jansen, Whiting and Hulbert, doi:10.1016/S0045-7825(00)00203-6 (first order); Chung and Hulbert,
doi:10.1115/1.2900803 (second order). :mod:`tigar_x.fem.time_integration` has the formulas of the coefficients.
"""

from dataclasses import dataclass
from typing import Any

from tigar_x import checks


@dataclass(frozen=True)
class Scheme:
    """Coefficients of a one-step scheme, see the module's formulas.

    Attributes:
        order: 1 for systems in x', 2 for systems in x''.
        alpha_f: level of x (and of x' in second-order systems).
        alpha_m: level of the highest rate.
        a0: factor of (x - x_n)/dt in x'.
        a1: factor of x'_n in x'.
        a2: factor of dt x''_n in x'.
        b0: factor of (x' - x'_n)/dt in x''.
        b1: factor of x''_n in x''.
    """

    order: int
    alpha_f: float
    alpha_m: float
    a0: float
    a1: float
    a2: float = 0.0
    b0: float = 0.0
    b1: float = 0.0


def require_scheme(name: str, value: Any) -> None:
    """Refuse what is no scheme.

    Args:
        name: what messages call it.
        value: the scheme.

    Raises:
        ValueError: it is something else, such as a number or a function that makes schemes.
    """
    checks.kind(name, value, Scheme, "a scheme, such as generalized_alpha(0.5),")


def generalized_alpha(rho_infinity: float, order: int = 1, *, first_order_alpha_m: bool = False) -> Scheme:
    """Generalized-alpha scheme.

    Args:
        rho_infinity: spectral radius at infinite frequency, in [0, 1].
        order: 1 or 2, the order of the system in time.
        first_order_alpha_m: for a second-order system that is coupled to a first-order one, use the latter's alpha_m,
            so that both share the intermediate level and gamma.

    Returns:
        The scheme.

    Raises:
        ValueError: a parameter is out of range.
    """
    rho = checks.within("rho_infinity", rho_infinity, 0.0, 1.0)
    checks.choice("order", order, (1, 2))
    checks.flag("first_order_alpha_m", first_order_alpha_m)
    alpha_f = 1.0 / (1.0 + rho)
    alpha_m = 0.5 * (3.0 - rho) / (1.0 + rho)
    if order == 2 and not first_order_alpha_m:
        alpha_m = (2.0 - rho) / (1.0 + rho)
    gamma = 0.5 + alpha_m - alpha_f
    if order == 1:
        return Scheme(1, alpha_f, alpha_m, a0=1.0 / gamma, a1=(gamma - 1.0) / gamma)
    beta = 0.25 * (1.0 + alpha_m - alpha_f) ** 2
    a0, a2 = gamma / beta, (1.0 - gamma) - gamma * (1.0 - 2.0 * beta) / (2.0 * beta)
    return Scheme(2, alpha_f, alpha_m, a0=a0, a1=1.0 - a0, a2=a2, b0=1.0 / gamma, b1=-(1.0 - gamma) / gamma)


def backward_euler(order: int = 1) -> Scheme:
    """Backward Euler: ``x' = (x - x_n)/dt`` and, for order 2, ``x'' = (x' - x'_n)/dt``.

    Args:
        order: 1 or 2, the order of the system in time.

    Returns:
        The scheme.

    Raises:
        ValueError: another order.
    """
    checks.choice("order", order, (1, 2))
    return Scheme(order, 1.0, 1.0, a0=1.0, a1=0.0, b0=float(order == 2))


def companion(scheme: Scheme) -> Scheme:
    """Second-order scheme at the level of a first-order one, for what moves along with the unknown of the latter.

    Args:
        scheme: first-order scheme.

    Returns:
        The scheme of order 2 with the same levels and the same relation of the two highest rates.

    Raises:
        ValueError: the scheme has another order.
    """
    require_scheme("scheme", scheme)
    checks.choice("order of scheme", scheme.order, (1,))
    if scheme.alpha_f == scheme.alpha_m == 1.0:
        return backward_euler(2)
    return generalized_alpha(1.0 / scheme.alpha_f - 1.0, 2, first_order_alpha_m=True)
