"""Simulation of followers in machine code, for calibrations on a CPU (A6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor

from lcc_rl.functional.driver_models import DriverConstants, follow
from lcc_rl.functional.machine_code import kept
from lcc_rl.functional.recorder import NUMBER_TYPES, Recorder

# The inner loop over the candidates of a driver compiles to vector instructions. numba removes the
# branch for an argument that is None. Gaps follow the trapezoidal rule (A18d); its leader's part is
# the same for all candidates.
TEMPLATE = """
def kernel(apart, leader, follower, gaps, samples, parameters, total):
    speed, gap = np.empty_like(total[0, 0]), np.empty_like(total[0, 0])
{memory}
    for driver in range(total.shape[1]):
{own}
        error, distance = total[0, driver], total[1, driver]
        speed[:], gap[:] = follower[driver, 0], gaps[driver, 0]
        error[:], distance[:] = {zero}, {zero}
        for i in range(len(speed)):
{before}
        for step in range(samples[driver] - 1):
            ahead, ahead_reached = leader[driver, step], leader[driver, step + 1]
            advance = {half} * (ahead + ahead_reached)
            truth, seen = follower[driver, step + 1], gaps[driver, step + 1]
            for i in range(len(speed)):
{step}
                gap[i] += advance - {half} * (speed[i] + {reached})
                speed[i] = {reached}
                error[i] += ({reached} - truth) * ({reached} - truth)
                if apart is not None:
                    distance[i] += (gap[i] - seen) * (gap[i] - seen)
"""
STEP_INPUTS = ("speed[i]", "gap[i]", "ahead", "ahead_reached")  # variables that a step changes


def squared_errors(
    law: DriverConstants, time_step: float, dtype: torch.dtype
) -> Callable[..., None]:
    """Return a function that sums squared errors of followers for many candidates of each driver.

    It is compiled from :func:`lcc_rl.functional.driver_models.follow` with the law:
    ``kernel(apart, leader, follower, gaps, samples, parameters, total)``.

    * apart: None: the errors of the gap are not summed and zero;
    * leader, follower: observed speeds, ``[drivers, time]`` [m/s]; gaps: likewise [m];
    * samples: number of samples, ``[drivers]``;
    * parameters: those of the law's table, each ``[drivers, candidates]``;
    * total: overwritten by the sums for speed and gap, ``[2, drivers, candidates]``.

    Args:
        law: the driver model with the constants that the calibration does not fit.
        time_step: T [s].
        dtype: type of all numbers.

    Raises:
        Untranslatable: if the law has an operation without a counterpart on numbers.
    """
    constants = {name: x for name, x in vars(law).items() if name not in law.shared()}
    return kept(_source(type(law), tuple(constants.items()), time_step, dtype), fused=True)


@cache
def _source(
    kind: type[DriverConstants],
    constants: tuple[tuple[str, Any], ...],
    time_step: float,
    dtype: torch.dtype,
) -> str:
    """Return the source of a kernel from one recorded step of a follower."""
    recorder, names = Recorder(), list(kind.table())

    def number(expression: str) -> Tensor:
        tensor = torch.ones(1, dtype=dtype)
        recorder.add(tensor, torch.tensor([recorder.variable(expression, ())]))
        return tensor

    motion = [number(expression) for expression in STEP_INPUTS]
    own = {name: number(f"p{place}[i]") for place, name in enumerate(names)}
    with torch.no_grad(), recorder:
        speed, gap, *leader = motion
        law = kind(**dict(constants)).with_(**{name: own[name] for name in kind.shared()})
        pair = own["desired_speed"], own["time_gap"]
        reached, *_ = next(follow(law, torch.stack(leader), speed, gap, pair, time_step))
    return _written(recorder, int(recorder.numbers(reached, dtype)), time_step, NUMBER_TYPES[dtype])


def _written(recorder: Recorder, reached: int, time_step: float, number: str) -> str:
    """Return the source; expressions of a driver's parameters only are computed before its steps.

    This includes reciprocals of such divisors, by which a step multiplies.
    """
    statements, inputs = recorder.statements, range(len(STEP_INPUTS))
    changing = recorder.dependents(inputs)
    for variable in sorted(changing):
        formula, reads = statements[variable]
        if formula == "{0} / {1}" and reads[1] not in changing:
            inverse = recorder.variable(f"{number}(1) / {{0}}", reads[1:])
            statements[variable] = ("{0} * {1}", (reads[0], inverse))
    used = recorder.needed([reached])
    parameters = [i for i in used if statements[i][0].startswith("p") and not statements[i][1]]
    held = recorder.dependents(parameters)  # or changing
    texts = {i: statements[i][0] for i in (*inputs, *parameters)}
    before: list[str] = []
    step: list[str] = []
    # Reciprocals were recorded last.
    for i in sorted(set(used) - set(texts), key=lambda i: (i in changing, i)):
        formula, reads = statements[i]
        expression = formula.format(*(texts[x] for x in reads))
        if i in changing:
            step.append(f"v{i} = {expression}")
            texts[i] = f"v{i}"
        elif i in held:
            before.append(f"h{i}[i] = {expression}")
            texts[i] = f"h{i}[i]"
        else:
            texts[i] = f"({expression})"
    places = [int(texts[i][1:-3]) for i in parameters]
    return TEMPLATE.format(
        memory=_indented(4, [f"{x.split('[')[0]} = np.empty_like(total[0, 0])" for x in before]),
        own=_indented(8, [f"p{place} = parameters[{place}][driver]" for place in places]),
        before=_indented(12, before or ["pass"]),
        step=_indented(16, step),
        reached=texts[reached],
        half=f"{number}({0.5 * time_step!r})",
        zero=f"{number}(0)",
    )


def _indented(spaces: int, lines: Sequence[str]) -> str:
    return "\n".join(" " * spaces + line for line in lines)
