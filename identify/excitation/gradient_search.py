"""Exciting trajectory by IPOPT with CasADi's exact derivatives of criterion and constraints.

The Hessian is approximated from gradients (limited memory): a criterion with 48 unknowns converges with it in some
tens of iterations, and an exact Hessian of a regressor costs more than it saves. Several starts, because the criterion
has many local optima. Limits that a start is far from are left out at first; those that the result breaks are put in,
and IPOPT climbs on. What goes over a limit between the instants of the constraints is drawn in towards home until it is
admissible at the finer instants of the check.
"""

from typing import Any

import casadi as ca
import numpy as np

from identify.arrays import Array
from identify.errors import TrajectoryError
from identify.excitation.motion import motion
from identify.excitation.search import SearchProblem, SearchResult
from identify.progress import Advance
from identify.runtime import honoured, one_thread, raise_noted

MOST_ITERATIONS = 150

TOLERANCE = 1e-4
"""IPOPT's, relative: further digits of an optimum do not excite more."""

INTERIOR = 0.98
"""A start is drawn in to this share of the limits, where the interior-point method can move."""

FAR = 0.5
"""A limit of which a start uses less than this share is left out at first."""

ALWAYS = "box"
"""The limit that always counts: without it a criterion grows without end."""


@honoured()
def climb(problem: SearchProblem, starts: list[Array], advance: Advance = lambda n=1: None) -> list[SearchResult]:
    """What IPOPT finds from each of the starts (z), best first; `advance` per start.

    Raises TrajectoryError where no start is admissible, or IPOPT finds nothing from any of them, with its reasons.
    """
    found, reasons = [], []
    for start in starts:
        result = _climb_from(problem, INTERIOR * problem.drawn_in(start))
        reasons.append(result.reason)
        if np.isfinite(result.log_value):
            found.append(result)
        advance()
    if not found:
        raise TrajectoryError(f"IPOPT found no trajectory from any of {len(starts)} starts: {', '.join(reasons)}")
    return sorted(found, key=lambda result: -result.log_value)


def _climb_from(problem: SearchProblem, z: Array) -> SearchResult:
    """One climb; its value is -inf where IPOPT came to nothing."""
    counted = {ALWAYS} | _used(problem, z, FAR)
    values = gradients = iterations = 0
    while True:
        solver = _solver(problem, counted)
        done, stats = _solve(solver, z)
        values, gradients = values + int(stats["n_call_nlp_f"]), gradients + int(stats["n_call_nlp_grad_f"])
        iterations, reason = iterations + int(stats["iter_count"]), str(stats["return_status"])
        found = np.array(done["x"]).ravel()
        if not np.isfinite(found).all() or not np.isfinite(float(done["f"])):
            return SearchResult(z, -np.inf, values, gradients, iterations, reason)
        broken = _used(problem, found, 1.0) - counted
        admissible = problem.drawn_in(found)
        if not broken:
            return SearchResult(admissible, float(problem.value(admissible)), values, gradients, iterations, reason)
        counted, z = counted | broken, INTERIOR * admissible


@one_thread
def _solve(solver: ca.Function, z: Array) -> tuple[dict[str, ca.DM], dict[str, Any]]:
    """What IPOPT finds from z, and its statistics."""
    done = solver(x0=z, lbg=-1.0, ubg=1.0)
    raise_noted()  # IPOPT takes Ctrl-C for an evaluation that failed
    return done, solver.stats()


def _used(problem: SearchProblem, z: Array, share: float) -> set[str]:
    """Names of the limits of which z uses more than a share."""
    return {worst.name for worst in problem.worst(z) if not worst.share <= share}


def _solver(problem: SearchProblem, counted: set[str]) -> ca.Function:
    """IPOPT for the problem with the limits `counted`, whose shares stay within -1 and 1."""
    z = ca.MX.sym("z", problem.unknowns.size)
    poses, rates, _ = motion(problem.unknowns, z, problem.times)
    shares = problem.constraints.shares_of(counted).map(len(problem.times))(poses, rates)
    options: dict[str, Any] = {
        "print_time": False,
        "ipopt": {
            "print_level": 0,
            "sb": "yes",
            "hessian_approximation": "limited-memory",
            "max_iter": MOST_ITERATIONS,
            "tol": TOLERANCE,
            "acceptable_tol": 10 * TOLERANCE,
            "acceptable_iter": 5,
        },
    }
    nlp: dict[str, Any] = {"x": z, "f": -problem.smooth(z), "g": ca.vec(shares)}
    return ca.nlpsol("excitation", "ipopt", nlp, options)
