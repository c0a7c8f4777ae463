"""A driving program as one function in C99 without dependencies, for a car's control unit.

The statements are those that :mod:`lcc_rl.functional.recorder` records from the program. Compile
with ``-std=c99`` or ``-ffp-contract=off``, so that products and sums are not fused.
"""

from __future__ import annotations

import re

import numpy as np
import torch

from lcc_rl.envs.rowwise import Array, recorded
from lcc_rl.errors import ConfigError
from lcc_rl.functional.recorder import COMPARISONS, Untranslatable
from lcc_rl.interfaces.exported import DrivingProgram, described_input

HEAD = """\
#include <math.h>
#include <stdint.h>

#define f32(x) ((float)(x))
#define f64(x) ((double)(x))
#define i64(x) ((int64_t)(x))
#define flag(x) ((x) != 0)
#define pick(condition, one, other) ((condition) ? (one) : (other))
"""
LAYER = """
static void layer(const float *weights, const float *bias, const float *inputs, int count,
                  float *found, int units) {
    for (int unit = 0; unit < units; unit++) {
        found[unit] = bias[unit];
        for (int place = 0; place < count; place++)
            found[unit] += inputs[place] * weights[place * units + unit];
    }
}
"""
# Functions of the recorder's statements and their names in C, of numbers of single precision.
FUNCTIONS = {
    f"np.{name}": f"{name}f"
    for name in ("sqrt", "exp", "log", "log1p", "sin", "cos", "floor", "rint", "tanh")
}
FUNCTIONS |= {"np.arctanh": "atanhf", "abs": "fabsf", "inf": "INFINITY", "nan": "NAN"}
FUNCTIONS |= {"True": "1", "False": "0"}
WORD = re.compile("|".join(rf"\b{re.escape(word)}\b" for word in FUNCTIONS))
TRUTHS = {*COMPARISONS.values(), "{0} == 0"}  # formulas whose results are truth values
TYPES = {"f32(": "float", "f64(": "double", "i64(": "int64_t", "flag(": "int", "x": "float"}


def c_code(module: DrivingProgram, about: str) -> str:
    """Return the source of a program, with its description ``about``, as a function ``step``.

    Raises:
        ConfigError: naming the operation that has no counterpart in C here.
    """
    examples = [torch.ones(1, width) for width in (len(module.names), module.width) if width]
    try:
        recorder, outputs = recorded(module if module.width else module.step, examples)
        body, types = [], dict[int, str]()
        for i in recorder.needed(variable for output in outputs for variable in output):
            body += _statement(i, *recorder.statements[i], types)
    except Untranslatable as error:
        raise ConfigError(f"C code of this policy or rule: {error} is not supported") from error
    body += [f"memory[{index}] = v{i};" for index, i in enumerate((*outputs, ())[1])]
    lines = "".join(f"    {line}\n" for line in [*body, f"return v{outputs[0][0]};"])
    inputs = [described_input(name) for name in module.names]
    columns = "".join(f" * state[{k}]: {x.name} [{x.unit}]\n" for k, x in enumerate(inputs))
    tables = "".join(_table(f"t{k}", x.numpy()) for k, x in enumerate(recorder.tables))
    comment = "/* " + about.replace("*/", "* /") + f"\n *\n{columns}"
    change = ", not when" if module.observation is None else " or"  # as in simulations
    comment += f" * memory[{module.width}]: zeros when the car begins{change} its target changes\n"
    comment += " * Returns the acceleration for the next step [m/s^2]. */\n"
    head = comment + HEAD + (LAYER if "layer(" in lines else "") + tables
    call = "float step(const float *state, float *memory) {\n    (void)memory;\n"
    return f"{head}\n{call}{lines}}}\n"


def _table(name: str, table: Array) -> str:
    numbers = ", ".join(f"{float(x).hex()}f" for x in table.astype(np.float32).flat)
    return f"\nstatic const float {name}[{table.size}] = {{{numbers}}};\n"


def _statement(i: int, formula: str, reads: tuple[int, ...], types: dict[int, str]) -> list[str]:
    """Return a recorded statement in C, and keep the type of its variable."""
    args = [f"v{x}" for x in reads]
    if formula.startswith("layer("):
        weights, bias = re.findall(r"t\d+", formula)
        units, types[i] = f"sizeof {bias} / sizeof *{bias}", "layer"
        before, inputs, count = "", args[0], f"sizeof {args[0]} / sizeof *{args[0]}"
        if types[reads[0]] != "layer":
            before, inputs, count = f", in{i}[] = {{{', '.join(args)}}}", f"in{i}", f"{len(args)}"
        call = f"layer({weights}, {bias}, {inputs}, {count}, v{i}, {units});"
        return [f"float v{i}[{units}]{before};", call]
    if formula.startswith("rectified("):
        units, types[i] = f"sizeof {args[0]} / sizeof *{args[0]}", "layer"
        line = f"v{i}[unit] = {args[0]}[unit] < 0 ? 0 : {args[0]}[unit];"
        return [
            f"float v{i}[{units}];",
            f"for (int unit = 0; unit < (int)({units}); unit++) {line}",
        ]
    if "**" in formula:
        formula = "powf({0}, {1})"
    elif re.search("ndtri|read|searchsorted", formula):
        raise Untranslatable(formula.split("(")[0])
    formula = re.sub(r"x0\[row, (\d+)\]", r"state[\1]", formula)
    formula = re.sub(r"x1\[row, (\d+)\]", r"memory[\1]", formula)
    text = WORD.sub(lambda match: FUNCTIONS[match[0]], formula)
    kind = next((kind for word, kind in TYPES.items() if formula.startswith(word)), None)
    operands = [types[x] for x in reads if types[x] != "layer"]
    types[i] = "int" if formula in TRUTHS else kind or ["float", *operands][-1]
    return [f"const {types[i]} v{i} = {text.format(*args)};"]
