"""Records operations on tensors as statements on single numbers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

MOST_STATEMENTS = 4000  # numba takes 2 to 4 s for each thousand

NUMBER_TYPES = {torch.float32: "f32", torch.float64: "f64", torch.int64: "i64", torch.bool: "flag"}
# Formulas of operations by their names in torch; numbers are {0}, {1}, …
ARITHMETIC = {
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "rsub": "{1} - {0}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "neg": "-{0}",
    "abs": "abs({0})",
    "reciprocal": "f32(1) / {0}",
    "sqrt": "np.sqrt({0})",
    "rsqrt": "f32(1) / np.sqrt({0})",
    "exp": "np.exp({0})",
    "log": "np.log({0})",
    "log1p": "np.log1p({0})",
    "sin": "np.sin({0})",
    "cos": "np.cos({0})",
    "floor": "np.floor({0})",
    "round": "np.rint({0})",
    "atanh": "np.arctanh({0})",
    "tanh": "np.tanh({0})",
    "sigmoid": "f32(1) / (f32(1) + np.exp(-{0}))",
    "softplus": "pick({0} > 20, {0}, np.log1p(np.exp({0})))",
    "relu": "pick({0} < 0, f32(0), {0})",
    "special_ndtri": "f32(ndtri({0}))",
    "pow": "{0} ** {1}",
    "lerp": "{0} + {2} * ({1} - {0})",
    # NaN is kept, as in torch.
    "maximum": "pick(({0} > {1}) | ({0} != {0}), {0}, {1})",
    "minimum": "pick(({0} < {1}) | ({0} != {0}), {0}, {1})",
    "bitwise_and": "{0} & {1}",
    "bitwise_or": "{0} | {1}",
    "bitwise_xor": "{0} ^ {1}",
    "__rshift__": "{0} >> {1}",
    "logical_and": "{0} & {1}",
    "logical_or": "{0} | {1}",
    "logical_not": "{0} == 0",
    "_to_copy": "{0}",
}
COMPARISONS = {
    "gt": "{0} > {1}",
    "ge": "{0} >= {1}",
    "lt": "{0} < {1}",
    "le": "{0} <= {1}",
    "eq": "{0} == {1}",
    "ne": "{0} != {1}",
}
METHODS = (  # methods of Recorder
    *("addmm", "bitwise_not", "bucketize", "clamp", "cumsum", "gather", "index", "masked_fill"),
    *("searchsorted", "where"),
)
REDUCTIONS = {
    "sum": "add",
    "any": "logical_or",
    "all": "logical_and",
    "amin": "minimum",
    "amax": "maximum",
}
# These move entries and are applied to the numbers of the variables.
MOVES = {
    "_unsafe_view", "alias", "cat", "clone", "detach", "expand", "flip", "permute", "repeat",
    "select", "slice", "split", "split_with_sizes", "squeeze", "stack", "t", "transpose", "unbind",
    "unsqueeze", "view",
}  # fmt: skip
# These read the shape of their argument only.
SHAPES = {"zeros_like", "ones_like", "full_like", "empty_like", "new_zeros", "new_ones", "new_full"}


TAKING = (Tensor.numpy, Tensor.__array__, Tensor.tolist)  # methods that return no tensor


class Untranslatable(Exception):
    """An operation has no counterpart on single numbers."""


class TensorsOnly(TorchFunctionMode):
    """Refuses to convert tensors to numbers, which a recorder would take for constants."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        if func in TAKING:
            raise Untranslatable(f"it takes numbers out of tensors by {func.__name__}")
        return func(*args, **(kwargs or {}))


class Recorder(TorchDispatchMode):
    """Records operations on tensors as statements on numbers.

    Every entry of a tensor that depends on the inputs is a variable with a number. The numbers are
    kept in a tensor of the same shape. All other tensors are constants.

    Attributes:
        statements: the expression of each variable, and the variables that it reads.
        tables: constants that are read at a place that depends on the inputs.
    """

    def __init__(self) -> None:
        super().__init__()
        self.statements: list[tuple[str, tuple[int, ...]]] = []
        self.known: dict[tuple[str, tuple[int, ...]], int] = {}
        self.variables: dict[int, tuple[Tensor, Tensor]] = {}  # by the id of the tensor
        self.tables: list[Tensor] = []
        self.layers: dict[tuple[int, ...], int] = {}  # variables of whole arrays, and the array's

    def add(self, tensor: Tensor, variables: Tensor) -> None:
        """Record the variables of a tensor."""
        self.variables[id(tensor)] = (tensor, variables)  # kept, so that its id stays its own

    def of(self, value: Any) -> Tensor | None:
        """Return the variables of a tensor; None for a constant."""
        found = self.variables.get(id(value))
        return None if found is None else found[1]

    def variable(self, expression: str, reads: tuple[int, ...]) -> int:
        """Return the variable with the value of an expression, ``{0}`` for the first one read."""
        statement = (expression, reads)
        if statement not in self.known:
            self.known[statement] = len(self.statements)
            self.statements.append(statement)
            if len(self.statements) > MOST_STATEMENTS:
                raise Untranslatable(f"it takes more than {MOST_STATEMENTS} statements")
        return self.known[statement]

    def needed(self, results: Iterable[int]) -> list[int]:
        """Return the results and all variables that they depend on, in order."""
        found, left = set[int](), list(results)
        while left:
            if (variable := left.pop()) not in found:
                found.add(variable)
                left += self.statements[variable][1]
        return sorted(found)

    def dependents(self, inputs: Iterable[int]) -> set[int]:
        """Return the inputs and all variables that depend on them."""
        found = set(inputs)
        for variable, (_, reads) in enumerate(self.statements):
            if not found.isdisjoint(reads):
                found.add(variable)
        return found

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        result = func(*args, **kwargs)
        name = func.overloadpacket.__name__
        given = [part for x in args for part in (x if isinstance(x, (list, tuple)) else [x])]
        if name in SHAPES or all(self.of(x) is None for x in given):
            return result
        if name in MOVES:
            self._move(func, args, kwargs, result)
        elif name in METHODS:
            self.add(result, getattr(self, f"_{name}")(result, *args, **kwargs))
        elif name in REDUCTIONS:
            self.add(result, self._fold(name, result, *args, **kwargs))
        elif name == "_to_copy" or (name in {*ARITHMETIC, *COMPARISONS} and not kwargs):
            self.add(result, self._each(name, result.dtype, *given))
        else:
            raise Untranslatable(str(func))
        return result

    def _each(self, name: str, dtype: torch.dtype, *values: Any) -> Tensor:
        """Record an operation on single entries."""
        if name == "pow" and isinstance(values[1], float) and values[1] == 0.5:  # so does torch
            name, values = "sqrt", values[:1]
        if name in COMPARISONS:
            dtype = torch.result_type(*values)
        formula = COMPARISONS.get(name) or ARITHMETIC[name]
        if f"{{{len(values) - 1}}}" not in formula:
            raise Untranslatable(f"{name} of {len(values)} arguments")
        if name == "relu" and self.layers:
            return self._rectified(formula, self.numbers(values[0], dtype))
        return self._stated(formula, [self.numbers(x, dtype) for x in values])

    def _stated(self, formula: str, parts: Sequence[Tensor]) -> Tensor:
        """Record a formula for every entry of variables; return the variables of the results."""
        if formula == "{0}":
            return parts[0]
        parts = torch.broadcast_tensors(*parts)
        rows = zip(*(part.flatten().tolist() for part in parts), strict=True)
        found = [self.variable(formula, row) for row in rows]
        return torch.tensor(found, dtype=torch.int64).reshape(parts[0].shape)

    def numbers(self, value: Any, dtype: torch.dtype) -> Tensor:
        """Return the variables of a value, converted to a type."""
        if (kind := NUMBER_TYPES.get(dtype)) is None:
            raise Untranslatable(f"numbers of {dtype}")
        variables = self.of(value)
        if variables is not None:
            same = value.dtype == dtype
            return variables if same else self._stated(f"{kind}({{0}})", [variables])
        if isinstance(value, int):  # a stream's counter may exceed int64 and wraps
            value = (value + 2**63) % 2**64 - 2**63
        value = torch.as_tensor(value, dtype=dtype)
        literals = [self.variable(f"{kind}({x!r})", ()) for x in value.flatten().tolist()]
        return torch.tensor(literals, dtype=torch.int64).reshape(value.shape)

    def _move(self, func: Any, args: tuple[Any, ...], kwargs: Any, result: Any) -> None:
        results = (result,) if isinstance(result, Tensor) else result
        dtype = results[0].dtype

        def moved(value: Any) -> Any:
            if isinstance(value, (list, tuple)):
                return [moved(part) for part in value]
            return self.numbers(value, dtype) if isinstance(value, Tensor) else value

        found = func(*moved(args), **kwargs)
        parts = (found,) if isinstance(found, Tensor) else found
        for tensor, variables in zip(results, parts, strict=True):
            self.add(tensor, variables)

    def _fold(
        self, name: str, result: Tensor, value: Tensor, dims: Any = None, *keep: Any, **more: Any
    ) -> Tensor:
        dims = [dims] if isinstance(dims, int) else dims or list(range(value.ndim))
        variables = self.numbers(value, result.dtype).movedim(dims, [*range(len(dims))])
        parts = variables.flatten(0, len(dims) - 1).unbind(0)
        formula = ARITHMETIC[REDUCTIONS[name]]
        return reduce(lambda *two: self._stated(formula, two), parts).reshape(result.shape)

    def _addmm(self, result: Tensor, bias: Tensor, value: Tensor, weight: Tensor) -> Tensor:
        """Record a layer of a network; each row is one array."""
        if self.of(bias) is not None or self.of(weight) is not None:
            raise Untranslatable("weights that depend on the inputs")
        tables = f"{self._table(weight.contiguous())}, {self._table(bias)}"
        rows = []
        for row in self.numbers(value, result.dtype).tolist():
            numbers = "".join(f"{{{place}}}, " for place in range(len(row)))
            inputs, reads = f"({numbers})", tuple(row)
            if (whole := self.layers.get(reads)) is not None:
                inputs, reads = "{0}", (whole,)
            rows.append(self._array(f"layer({tables}, {inputs})", reads, len(bias)))
        return torch.tensor(rows, dtype=torch.int64)

    def _array(self, expression: str, reads: tuple[int, ...], size: int) -> list[int]:
        """Record an array; return the variables of its entries."""
        array = self.variable(expression, reads)
        entries = [self.variable(f"{{0}}[{place}]", (array,)) for place in range(size)]
        self.layers[tuple(entries)] = array
        return entries

    def _rectified(self, formula: str, variables: Tensor) -> Tensor:
        """Record ReLU, of a whole layer in one statement."""
        rows = [tuple(row) for row in variables.reshape(-1, variables.shape[-1]).tolist()]
        if not all(row in self.layers for row in rows):
            return self._stated(formula, [variables])
        found = [self._array("rectified({0})", (self.layers[x],), len(x)) for x in rows]
        return torch.tensor(found, dtype=torch.int64).reshape(variables.shape)

    def _bitwise_not(self, result: Tensor, value: Tensor) -> Tensor:
        return self._each("bitwise_xor", result.dtype, value, -1)

    def _where(self, result: Tensor, condition: Tensor, *values: Any) -> Tensor:
        parts = [self.numbers(x, result.dtype) for x in values]
        return self._stated("pick({0}, {1}, {2})", [self.numbers(condition, torch.bool), *parts])

    def _masked_fill(self, result: Tensor, value: Tensor, condition: Tensor, other: Any) -> Tensor:
        return self._where(result, condition, other, value)

    def _cumsum(self, result: Tensor, value: Tensor, dim: int, **more: Any) -> Tensor:
        parts = self.numbers(value, result.dtype).unbind(dim)
        sums = accumulate(parts, lambda *two: self._stated(ARITHMETIC["add"], two))
        return torch.stack([*sums], dim)

    def _gather(self, result: Tensor, value: Tensor, dim: int, place: Tensor) -> Tensor:
        dim, places = dim % value.ndim, self.numbers(place, torch.int64)
        within = (slice(None if x == dim else n) for x, n in enumerate(place.shape))
        parts = self.numbers(value, result.dtype)[tuple(within)].split(1, dim)
        numbers = "".join(f"{{{number}}}, " for number in range(1, len(parts) + 1))
        return self._stated(f"read(({numbers}), {{0}})", [places, *parts])

    def _clamp(self, result: Tensor, value: Tensor, low: Any = None, high: Any = None) -> Tensor:
        variables = self.numbers(value, result.dtype)
        for bound, order in ((low, "<"), (high, ">")):
            if bound is not None:
                parts = [variables, self.numbers(bound, result.dtype)]
                variables = self._stated(f"pick({{0}} {order} {{1}}, {{1}}, {{0}})", parts)
        return variables

    def _index(self, result: Tensor, value: Tensor, places: Sequence[Tensor | None]) -> Tensor:
        variables = self.of(value)
        if variables is None:
            return self._read(result, value, places)
        if any(self.of(place) is not None for place in places):
            raise Untranslatable("indices and values that both depend on the inputs")
        return variables[tuple(slice(None) if x is None else x for x in places)]

    def _read(self, result: Tensor, table: Tensor, places: Sequence[Tensor | None]) -> Tensor:
        """Record a read of a constant at indices that depend on the inputs."""
        if any(place is None for place in places):
            raise Untranslatable("an index that is not of the first dimensions")
        inner = table.shape[len(places) :]
        outer = torch.broadcast_tensors(*(self.numbers(x, torch.int64) for x in places))
        parts = [x.reshape(*x.shape, *[1] * len(inner)) for x in outer]
        for axis, size in enumerate(inner):
            each = self.numbers(torch.arange(size), torch.int64)
            parts.append(each.reshape(size, *[1] * (len(inner) - 1 - axis)))
        where = ", ".join(f"{{{i}}}" for i in range(len(parts)))
        return self._stated(f"read({self._table(table)}, ({where},))", parts)

    def _searchsorted(
        self, result: Tensor, table: Tensor, value: Tensor, right: bool = False, **more: Any
    ) -> Tensor:
        if more or table.ndim != 1 or self.of(table) is not None:
            raise Untranslatable("a search in anything but one constant list")
        side = "right" if right else "left"
        formula = f"i64(np.searchsorted({self._table(table)}, {{0}}, '{side}'))"
        return self._stated(formula, [self.numbers(value, table.dtype)])

    def _bucketize(self, result: Tensor, value: Tensor, table: Tensor, **more: Any) -> Tensor:
        return self._searchsorted(result, table, value, **more)

    def _table(self, table: Tensor) -> str:
        """Return the name by which statements read a table."""
        if not any(known is table for known in self.tables):
            self.tables.append(table)
        return f"t{[known is table for known in self.tables].index(True)}"
