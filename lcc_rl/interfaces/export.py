"""Export of policies and rules as ONNX, PyTorch's ``.pt2``, C or a page of the ring road.

An exported program maps the measurements of a vehicle in SI units to its acceleration. It contains
the scales of the observation, the network and the safety filter, if there is one. The program of a
policy with a memory also reads and returns the memory.
"""

from __future__ import annotations

import json
import logging
import re
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf

from lcc_rl.config import load
from lcc_rl.config.words import with_variant
from lcc_rl.envs.rowwise import Array, recorded
from lcc_rl.errors import ConfigError, needing, require, require_known
from lcc_rl.evaluation.foreign import network_of
from lcc_rl.evaluation.named import is_policy, one_of
from lcc_rl.functional.recorder import COMPARISONS, Untranslatable
from lcc_rl.interfaces.driver import Driver
from lcc_rl.interfaces.exported import DrivingProgram, Safety, described_input, program
from lcc_rl.interfaces.onnx_policy import MAKES, TAKES
from lcc_rl.interfaces.ring_page import ring_page
from lcc_rl.io.atomic import atomic_path, new_file
from lcc_rl.pieces.base import SEED, Piece, State
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.string import COMMAND, WANTED
from lcc_rl.version import __version__

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


def c_code(module: DrivingProgram, about: str, name: str) -> str:
    """Return the source of a program with its description ``about``: ``<name>_step`` in C99.

    Other characters of the name than letters, digits and ``_`` become ``_``. It has no
    dependencies, for a car's control unit. The statements are those that
    :mod:`lcc_rl.functional.recorder` records from the program. Compile with ``-std=c99`` or
    ``-ffp-contract=off``, so that products and sums are not fused.

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
        memory = f", with a memory of {module.width} numbers," * (module.width > 0)
        text = f"C code of this policy or rule{memory} is not supported: {error}; use .onnx or .pt2"
        raise ConfigError(text) from error
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
    word = re.sub(r"^(?=\d)|\W", "_", f"{name}_step", flags=re.ASCII)
    call = f"float {word}(const float *state, float *memory) {{\n    (void)memory;\n"
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
        loop = f"for (int unit = 0; unit < (int)({units}); unit++) {line}"
        return [f"float v{i}[{units}];", loop]
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


def export(
    policy: Any,
    path: str | Path,
    trust: Sequence[str] = (),
    variant: str = "alcc",
    overrides: Sequence[str] = (),
    normalize: Any = None,
    safety: Safety = None,
    limits: Mapping[str, float] | None = None,
) -> Path:
    """Write a trained policy, with its safety filter, for other software.

    The ending selects the format. ONNX (``.onnx``) and PyTorch's exported program (``.pt2``) read
    ``state``, ``[batch, inputs]`` in SI units, and return ``acceleration``, ``[batch, 1]`` [m/s²].
    A policy with a memory also has the input ``memory`` (zeros at first) and the output
    ``next_memory``. C code (``follow.c``) is one function ``follow_step(state, memory)`` in C99.
    Names, units and meanings of the inputs are in the file's metadata under ``lcc_rl`` as JSON. A
    page (``.html``) shows the ring road with the policy in any browser, see
    :func:`lcc_rl.interfaces.ring_page.ring_page`.

    Args:
        policy: a run folder, a policy file, or ``pretrained/<name>``; a rule by name
            (``"idm_acc_filtered"``); a controller as for :func:`lcc_rl.simulate`; or a model
            of stable-baselines3 or a torch module from observations ``[batch, n]`` to actions
            ``[batch, 1]``.
        path: the file to write.
        trust: modules outside this package that the policy may name.
        variant, overrides: environment in which a model or module was trained; for a page the
            overrides are settings of its ring, for a trained policy's program those of its filter
            and of the car, such as ``safety.margin=2``, ``limits.max_braking=6``; a rule takes
            ``time_step=0.02``, by default 0.1 s.
        normalize: ``VecNormalize`` of a model; by default that of its environment.
        safety: the safety filter of a program, or changed settings of its own, such as
            ``{"margin": 2.0}``.
        limits: ``max_braking`` and ``max_acceleration`` of the car [m/s²]; by default those of the
            training, for rules 3.

    Returns:
        The path of the file.

    Raises:
        ConfigError: if the ending is unknown, an extra is missing, or the policy cannot be
            exported.
        ResultsError: if the policy cannot be read, or the file exists or cannot be written.

    Examples:
        >>> export("pretrained/alcc_limits", "alcc.pt2")  # doctest: +SKIP
    """
    changes = {"safety": safety, "limits": limits}
    return written(policy, path, trust, variant, overrides, normalize, **changes)[0]


def written(
    policy: Any,
    path: str | Path,
    trust: Sequence[str],
    variant: str = "alcc",
    overrides: Sequence[str] = (),
    normalize: Any = None,
    **given: Any,
) -> tuple[Path, DrivingProgram | None]:
    """Write the file, see :func:`export`; return its path and its program."""
    path = new_file(path, "name")
    require_known("ending", path.suffix, [*EXPORTERS, CODE, PAGE])
    network = None if isinstance(policy, Controller) else network_of(policy, normalize)
    name, spec = one_of(policy) if network is None else (type(policy).__name__, network)
    cfg = None if network is None else load("train", with_variant(variant, overrides))
    rule, module = cfg is None and not is_policy(spec), None
    if path.suffix == PAGE:
        text = f"{name}: a page ({PAGE}) needs a run or a policy file, and has its own filter"
        require(cfg is None and not (any(given.values()) or rule), text)
        content = ring_page(policy, trust, overrides).encode()
    else:
        if cfg is None and overrides:
            text = "overrides: safety.… and limits.… are given as arguments, too"
            require(all(x is None for x in given.values()), text)
            given = _changes(overrides, rule, path.suffix)
        module = _rule(policy, trust, **given) if rule else program(spec, trust, cfg, **given)
        about = described(module, name)
        if path.suffix == CODE:
            content = c_code(module, about, path.stem).encode()
        else:
            content = EXPORTERS[path.suffix](module, about)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    return path, module


def _changes(overrides: Sequence[str], rule: bool, ending: str) -> Any:
    """Return the settings of a program's filter and car and, of a rule, its time step."""
    words, kinds = [word.lstrip("+") for word in overrides], ("safety.", "limits.", "time_step=")
    text = f"{' '.join(overrides)}: a program ({ending}) takes safety.… and limits.…, no road; "
    own = "settings of a controller are in its yaml file or, in Python, its object"
    text += f"a rule takes time_step; {own}" * rule
    text += "a policy has the time step of its training" * (not rule)
    require(all(word.startswith(kinds[: 2 + rule]) for word in words), text)
    return OmegaConf.to_container(OmegaConf.from_dotlist(words))


def _rule(given: Any, trust: Sequence[str], time_step: Any = 0.1, **more: Any) -> DrivingProgram:
    """Return the program of a rule; ``time_step`` [s]; ``more`` as for a :class:`Driver`."""
    driver = Driver(given, time_step, trust, **more)
    noisy = SEED in driver.program.kept
    require(not noisy, f"{driver.name} draws noise from seeds: it cannot be exported")

    def tried(piece: Piece, before: State, reached: State) -> None:
        piece.derive(before, reached)
        commands = [reached[key] for key in piece.targets if key[-1] in (WANTED, COMMAND)]
        text = (
            f"{driver.name} cannot be exported: its command is not finite where all inputs are 10"
        )
        require(all(x.isfinite() for x in commands), text)

    partial(driver.program.step, apply=tried)(*driver.examples(1, 10.0))
    return driver.program


def described(module: DrivingProgram, name: str) -> str:
    """Return the description of a program as JSON: names, units and stand-ins of its inputs."""
    inputs = [described_input(name)._asdict() for name in module.names]
    for column in inputs:
        if column["name"] in module.stand_ins:
            column["stand_in"] = str(module.stand_ins[column["name"]])
    about: dict[str, Any] = {"policy": name, "lcc_rl": __version__, "inputs": inputs}
    about |= {"time_step_s": module.controller.time_step, "output": "acceleration [m/s²]"}
    return json.dumps(about | {"filter": module.safety is not None}, ensure_ascii=False)


def _program(module: DrivingProgram) -> Any:
    widths = [len(module.names), module.width][: 1 + (module.width > 0)]
    batch = dict(zip(TAKES, [{0: torch.export.Dim("batch", min=1)}] * len(widths), strict=False))
    examples = tuple(torch.ones(2, width) for width in widths)
    return torch.export.export(module, examples, dynamic_shapes=batch)


def _as_pt2(module: DrivingProgram, about: str) -> bytes:
    buffer = BytesIO()
    torch.export.save(_program(module), buffer, extra_files={"lcc_rl": about})
    return buffer.getvalue()


def _as_onnx(module: DrivingProgram, about: str) -> bytes:
    exported = _program(module)
    count = len(exported.graph_signature.user_inputs)
    with needing("interfaces", "write a .pt2, or install what .onnx needs"):
        import onnx
        import onnxscript  # noqa: F401 - torch needs it
    registry = logging.getLogger("torch.onnx._internal.exporter._registration")
    registry.setLevel(logging.ERROR)  # warnings about the missing torchvision
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # raised by torch about itself
        converted = torch.onnx.export(
            exported,
            (),
            dynamo=True,
            verbose=False,
            input_names=TAKES[:count],
            output_names=MAKES[:count],
        )
    assert converted is not None
    proto = converted.model_proto
    onnx.helper.set_model_props(proto, {"lcc_rl": about})
    return bytes(proto.SerializeToString())


CODE, PAGE = ".c", ".html"
EXPORTERS = {".onnx": _as_onnx, ".pt2": _as_pt2}
