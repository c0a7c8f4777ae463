"""Functions of tensors as loops over rows of numbers, in machine code.

An operation on a tensor costs torch some microseconds for any size. A step of one episode is about
300 operations on one row; as statements on single numbers it takes a few microseconds. The
statements are recorded from the function itself.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lcc_rl.functional.recorder import Recorder, TensorsOnly, Untranslatable
from lcc_rl.pieces.base import Key, State

log = logging.getLogger("lcc_rl")

FRACTION = re.compile(r"(f32|f64)\((-?\d+\.\d*[1-9]\d*(?:e[-+]?\d+)?|-?\d+e-\d+)\)")

Array = np.ndarray[Any, Any]
TensorFunction = Callable[..., Sequence[Tensor]]


class Rows:
    """Entries of a state, ``[n, …]``, as rows of double precision, which represent any seed."""

    def __init__(self, state: State, keys: list[Key]) -> None:
        self.keys = keys
        self.types = [(state[key].shape[1:], state[key].dtype) for key in keys]
        self.sizes = [shape.numel() for shape, _ in self.types]

    def packed(self, moment: State) -> Tensor:
        """Return the entries of a state as rows, ``[n, width]``."""
        return torch.cat([moment[key].flatten(1).double() for key in self.keys], 1)

    def entries(self, rows: Tensor) -> State:
        """Return the entries that rows contain."""
        columns = zip(self.keys, self.types, rows.split(self.sizes, 1), strict=True)
        return {key: x.to(dtype).reshape(-1, *shape) for key, (shape, dtype), x in columns}


class Rowwise:
    """A function of rows of numbers, computed row by row in machine code.

    If an operation has no counterpart on single numbers, the function is called with tensors.

    Args:
        function: maps tensors ``[n, width]`` to tensors ``[n, width]``, row by row.
        examples: a row of each argument, ``[1, width]``.
        what: name in the log if it is not translated.
        make: compiles its source to machine code; None: numba, kept on disk.
    Attributes:
        translated: whether it runs as machine code.
    """

    def __init__(
        self,
        function: TensorFunction,
        examples: Sequence[Tensor],
        what: str,
        make: Callable[[str], Callable[..., None]] | None = None,
    ) -> None:
        from numba.core.errors import NumbaError  # here: numba loads for a third of a second

        from lcc_rl.functional.machine_code import kept

        self.function = function
        with torch.no_grad():
            results = function(*examples)
        self.widths = [(x.shape[-1], x.numpy().dtype) for x in results]
        try:
            source, self.tables = translated(function, examples)
            self.kernel = (make or kept)(source)
            self.translated = True
            self(*(x.numpy() for x in examples))
        except (Untranslatable, NumbaError) as error:
            log.info("%s runs by tensors: %s", what, str(error).strip().splitlines()[0])
            self.translated = False

    def __call__(self, *arguments: Array) -> tuple[Array, ...]:
        """Return the results of all rows, arrays ``[n, width]``.

        Args:
            *arguments: arrays ``[n, width]`` of the types of the examples.
        """
        if self.translated:
            count = len(arguments[0])
            results = tuple([np.empty((count, width), dtype) for width, dtype in self.widths])
            self.kernel(*arguments, *results, *self.tables)
            return results
        with torch.no_grad():
            tensors = self.function(*(torch.from_numpy(x) for x in arguments))
        return tuple(x.numpy() for x in tensors)


def recorded(
    function: TensorFunction, examples: Sequence[Tensor]
) -> tuple[Recorder, list[list[int]]]:
    """Return the recorded statements of a function, and the variables of each of its results.

    Raises:
        Untranslatable: naming the operation that has no counterpart on single numbers.
    """
    recorder = Recorder()
    examples = [example.clone() for example in examples]
    for index, example in enumerate(examples):
        columns = range(example.shape[-1])
        variables = [recorder.variable(f"x{index}[row, {column}]", ()) for column in columns]
        recorder.add(example, torch.tensor(variables).reshape(1, -1))
    with torch.no_grad(), recorder, TensorsOnly():
        results = function(*examples)
    return recorder, [recorder.numbers(x, x.dtype).flatten().tolist() for x in results]


def translated(function: TensorFunction, examples: Sequence[Tensor]) -> tuple[str, list[Array]]:
    """Return the source of a function of numbers, and the tables that are its last arguments."""
    recorder, outputs = recorded(function, examples)
    lines, constants = [], list[float]()
    for i in recorder.needed(variable for output in outputs for variable in output):
        expression, reads = recorder.statements[i]
        # One source, compiled once, for functions that differ in their settings.
        if match := FRACTION.fullmatch(expression):
            expression = f"{match[1]}(c0[{len(constants)}])"
            constants.append(float(match[2]))
        lines.append(f"v{i} = " + expression.format(*(f"v{x}" for x in reads)))
    lines += [
        f"y{index}[row, {column}] = v{variable}"
        for index, output in enumerate(outputs)
        for column, variable in enumerate(output)
    ]
    tables = [*(table.detach().numpy() for table in recorder.tables), np.array(constants)]
    counts = (("x", examples), ("y", outputs), ("t", recorder.tables), ("c", [constants]))
    names = ", ".join(f"{name}{i}" for name, rows in counts for i in range(len(rows)))
    body = "".join(f"        {line}\n" for line in lines)
    source = f"def kernel({names}):\n    for row in range(len(x0)):\n{body}"
    return source, tables
