"""Small linear programs, handed to HiGHS."""

from __future__ import annotations

import highspy
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def linear_program(matrix: Floats, cost: Floats, rhs: Floats, free: int = 0, inequalities: int = 0) -> highspy.Highs:
    """Set HiGHS up for the least `cost @ x` where `matrix @ x = rhs` and x >= 0.

    The first `free` unknowns have any sign; the last `inequalities` rows are at least their right-hand side.
    """
    rows, n = matrix.shape
    column, row = np.nonzero(np.abs(matrix.T) > 1e-10)
    starts = np.searchsorted(column, np.arange(n + 1)).astype(np.int32)
    lower, upper = np.zeros(n), np.full(n, np.inf)
    lower[:free] = -np.inf
    row_upper = rhs.copy()
    row_upper[rows - inequalities :] = np.inf
    columnwise, least = int(highspy.MatrixFormat.kColwise), int(highspy.ObjSense.kMinimize)
    solver = highspy.Highs()
    for option, choice in _OPTIONS.items():
        solver.setOptionValue(option, choice)
    solver.passModel(
        *(n, rows, len(row), columnwise, least, 0.0, cost, lower, upper, rhs, row_upper),
        *(starts, row.astype(np.int32), matrix[row, column], np.zeros(n, dtype=np.int32)),
    )
    return solver


# The programs are small and well scaled, and only the right-hand side changes from one to the next: what
# helps with large ones would only cost time.
_OPTIONS: dict[str, bool | int | float | str] = {
    "output_flag": False,
    "threads": 1,
    "solver": "simplex",
    "presolve": "off",
    "simplex_scale_strategy": 0,
    "dual_simplex_cost_perturbation_multiplier": 0.0,
}


def has_solution(solver: highspy.Highs, certain: bool = False) -> bool:
    """Solve, and tell whether there is a solution; where one is `certain`, another answer is not believed at once."""
    believed = _ANSWERS[:1] if certain else _ANSWERS
    solver.run()
    for options in (_CAREFUL, _INTERIOR):
        if solver.getModelStatus() in believed:
            break
        solver.clearSolver()  # rounding got in the way: start afresh
        for option, choice in options.items():
            solver.setOptionValue(option, choice)
        solver.run()
    return bool(solver.getModelStatus() == _STATUS.kOptimal)


_STATUS = highspy.HighsModelStatus
_ANSWERS = (_STATUS.kOptimal, _STATUS.kInfeasible, _STATUS.kUnbounded, _STATUS.kUnboundedOrInfeasible)
# With all that HiGHS has against rounding; then by interior points, where the simplex method ends without an answer.
_CAREFUL: dict[str, bool | int | float | str] = {
    "presolve": "on",
    "simplex_scale_strategy": 2,
    "dual_simplex_cost_perturbation_multiplier": 1.0,
}
_INTERIOR: dict[str, bool | int | float | str] = {"solver": "ipm"}
