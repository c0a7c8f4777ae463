"""A policy as an ONNX program of any origin, which runs in onnxruntime.

A program has the input ``state``, ``[batch, inputs]``, and the output ``acceleration``,
``[batch, 1]`` [m/s²], in single precision for any batch. Its metadata contain under ``lcc_rl`` a
JSON text with name and unit of every input, in order (:data:`INPUT_UNITS`), and the output's unit::

    {"inputs": [{"name": "self.gap", "unit": "m"}], "output": "acceleration [m/s²]"}

A program with a memory has a further input ``memory`` and output ``next_memory``, ``[batch, n]``:
zeros at first, then the output of the previous step.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from lcc_rl.errors import ResultsError, needing, raised_as, require
from lcc_rl.io.paths import check_file
from lcc_rl.pieces.base import Entry, Piece, declared
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.views import AHEAD, BEHIND, SELF, TARGET_AGE, VEHICLES
from lcc_rl.pieces.world import World
from lcc_rl.settings import Positive, Settings, parse

ABOUT = "lcc_rl"  # key of the metadata
STATE_INPUT, MEMORY_INPUT = TAKES = ("state", "memory")
MAKES = ("acceleration", "next_memory")
# Possible inputs with their units: entries of a vehicle and of its neighbours.
INPUT_UNITS = {
    f"{view}.{key[1]}": entry.unit
    for view in (SELF, AHEAD, BEHIND)
    for key, entry in declared(Piece).items()
    if key[0] == VEHICLES
} | {f"{BEHIND}.present": "–", f"{SELF}.{TARGET_AGE}": "s"}
Short = Annotated[str, Field(max_length=100)]


class ProgramInput(Settings):
    """A column of a program's input."""

    name: Short
    unit: Short
    meaning: str = ""
    stand_in: Short = ""  # replaces a NaN: another input, or a number

    def validate(self) -> None:
        if self.name not in INPUT_UNITS:
            raise ValueError(
                f"{self.name!r} is not measured: expected self, ahead or behind and an entry of "
                "a vehicle, such as ahead.speed; the memory of a program is its input memory, and "
                "knowledge has settings that the file lacks: compare the policy that it was made of"
            )
        if self.unit != INPUT_UNITS[self.name]:
            raise ValueError(f"{self.name} is in {INPUT_UNITS[self.name]}, got {self.unit!r}")


class ProgramFacts(Settings):
    """Contents of a program's metadata."""

    inputs: Annotated[tuple[ProgramInput, ...], Field(min_length=1)]
    output: Literal["acceleration [m/s²]"]
    time_step_s: Positive | None = None  # of its memory


class Program:
    """An ONNX program in onnxruntime on the CPU.

    Args:
        path: its file, which must contain its weights.

    Attributes:
        names: its inputs, in order.
        memory: size of its memory.

    Raises:
        ConfigError: if onnxruntime is not installed.
        ResultsError: if the file cannot be read or is not such a program.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        check_file(Path(path))
        with needing("interfaces", f"{path} needs onnxruntime"):
            import onnxruntime as ort
        options = ort.SessionOptions()
        options.intra_op_num_threads, options.log_severity_level = torch.get_num_threads(), 4
        # From memory, so that a program cannot name other files for its weights.
        with raised_as(ResultsError, path, Exception):  # onnxruntime's have no common class
            content = Path(path).read_bytes()
            self.session = ort.InferenceSession(content, options, ["CPUExecutionProvider"])
        about = self.session.get_modelmeta().custom_metadata_map.get(ABOUT, "{}")
        facts = _facts(about, path)
        self.names, self.time_step = tuple(x.name for x in facts.inputs), facts.time_step_s
        self.memory = self._check_shapes()

    def __reduce__(self) -> Any:
        return Program, (self.path,)  # onnxruntime's own object cannot be copied

    def _check_shapes(self) -> int:
        """Check names, types and widths of inputs and outputs; return the width of the memory."""
        takes, makes = self.session.get_inputs(), self.session.get_outputs()
        names = [[x.name for x in side] for side in (takes, makes)]
        count = 1 + (MEMORY_INPUT in names[0])
        expected = [list(TAKES[:count]), list(MAKES[:count])]
        shapes = {x.name: x.shape for x in takes}
        state, memory = shapes.get(STATE_INPUT, []), shapes.get(MEMORY_INPUT, ["batch", 0])
        right = names == expected and len(memory) == 2 and isinstance(memory[1], int)
        right = right and len(state) == 2 and state[1] == len(self.names)
        if not right or any(x.type != "tensor(float)" for x in (*takes, *makes)):
            raise ResultsError(
                f"{self.path}: expected the input {STATE_INPUT} [batch, {len(self.names)}], maybe "
                f"{MEMORY_INPUT} [batch, n], and the outputs {' and '.join(MAKES[:count])}, in "
                f"single precision; got {names[0]} of {list(shapes.values())}, {names[1]}"
            )
        return int(memory[1])

    def __call__(self, *inputs: Tensor) -> list[Tensor]:
        """Return the accelerations, ``[batch, 1]``, and the memory if there is one.

        Args:
            *inputs: the state, ``[batch, inputs]``, and the memory, ``[batch, n]``.
        """
        named = zip(TAKES, inputs, strict=False)
        feed = {name: value.detach().cpu().float().numpy() for name, value in named}
        with raised_as(ResultsError, self.path, Exception):
            outputs = self.session.run(None, feed)
        widths = [1, self.memory][: len(outputs)]
        for value, width in zip(outputs, widths, strict=True):
            require(
                value.shape == (len(inputs[0]), width),
                f"{self.path}: it returned {list(value.shape)}, expected [batch, {width}]",
            )
        return [torch.as_tensor(value).to(inputs[0]) for value in outputs]


def _facts(text: str, path: str) -> ProgramFacts:
    """Read the metadata of a program."""
    with raised_as(ResultsError, f"{path}: its metadata {ABOUT} are no JSON", ValueError):
        about = json.loads(text)
    require(
        about != {},
        f"{path}: it lacks the metadata {ABOUT}, which name its inputs; docs/interfaces.md "
        "(Policies made elsewhere) shows how to write them",
    )
    require(isinstance(about, dict), f"{path}: its metadata {ABOUT} must be a JSON object")
    facts = {key: about[key] for key in ("inputs", "output", "time_step_s") if key in about}
    return parse(ProgramFacts, facts, f"{path}, metadata {ABOUT}")


class OnnxPolicy(Controller):
    """An ONNX program as a controller; its metadata name its inputs, see the module.

    The memory of a program is kept in ``(role, "program")``, ``[*batch, n, width]``. The controller
    passes no gradient.
    """

    path: str  # the program's file
    max_acceleration: Positive | None = None  # None: the limits of the vehicles [m/s²]

    def validate(self) -> None:
        """Read the program, so that an invalid one is refused at once."""
        self.program = Program(self.path)

    def setup(self, world: World) -> None:
        width, step = self.program.memory, self.program.time_step
        text = f"{self.path}: its memory is for steps of {step} s, not {world.time_step:g} s"
        require(not width or abs((step or world.time_step) - world.time_step) < 1e-9, text)
        memory = [Entry("role.program", "–", "memory of the program", width)] * bool(width)
        self.declare(world, self.program.names, remembers=memory)

    @torch.compiler.disable
    def command(self, *entries: Tensor) -> tuple[Tensor, ...]:
        """Return the commands, and the memory if there is one."""
        count, rows = len(self.program.names), entries[0].shape[:-1]
        inputs = [torch.cat(entries[:count], -1), *entries[count:]]
        results = self.program(*(value.reshape(rows.numel(), -1) for value in inputs))
        return tuple(value.view(*rows, -1) for value in results)
