"""All estimators by name."""

from collections.abc import Callable
from dataclasses import dataclass

from identify.errors import ScenarioError
from identify.estimators.evidence import Estimate, Evidence
from identify.estimators.instrumental_variables import instrumental_variables
from identify.estimators.least_squares import encoder_route, least_squares, weighted_least_squares
from identify.estimators.output_error_routes import closed_loop, command_driven, known_pid, warm_start_alone
from identify.estimators.total_least_squares import total_least_squares


@dataclass(frozen=True)
class Estimator:
    """An estimator: what it is in words, what it uses beside commands and poses, and the function."""

    title: str
    uses: str
    estimate: Callable[[Evidence], Estimate]


ESTIMATORS: dict[str, Estimator] = {
    "closed_loop": Estimator("output error, unknown PID", "poses", closed_loop),
    "command_driven": Estimator("output error, command driven", "poses", command_driven),
    "known_pid": Estimator("output error, known PID", "poses, gains", known_pid),
    "warm_start": Estimator("linear warm start alone", "poses", warm_start_alone),
    "torque_ls": Estimator("torque, LS", "poses, torque", least_squares),
    "torque_wls": Estimator("torque, weighted LS", "poses, torque", weighted_least_squares),
    "torque_iv": Estimator("torque, IV", "poses, torque", instrumental_variables),
    "torque_tls": Estimator("torque, total LS", "poses, torque", total_least_squares),
    "encoders": Estimator("encoders, weighted LS", "encoders, torque", encoder_route),
}


def choose(names: list[str] | None) -> dict[str, Estimator]:
    """The named estimators in the order of the table, or all. Raises ScenarioError, with the valid names."""
    unknown = [name for name in names or [] if name not in ESTIMATORS]
    if unknown:
        raise ScenarioError(f"unknown estimator {unknown[0]!r}; valid: {', '.join(ESTIMATORS)}")
    return {name: one for name, one in ESTIMATORS.items() if not names or name in names}
