"""A function of the environment, compiled where there is a compiler."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, compile

from lcc_rl.functional.recorder import TensorsOnly
from lcc_rl.io.memory import uncollected

log = logging.getLogger("lcc_rl")

# Attributes in which an object with a compiled method keeps the environment and its pieces.
CONSTANT = ("self.env", "self.step", "self.first", "_modules['transforms']._modules[")
LONGEST_VECTOR = 16  # numbers
# Bits of a vector; torch's key of a compiled graph lacks them, so that a cache shared by processors
# of two kinds gives kernels that leave out half of the entries.
VECTORS = {"AVX512": 512, "AVX2": 256}
CACHE_LOG = "torch._inductor.codecache"  # prints a traceback for a damaged file, and compiles anew


def options(device: torch.device | None) -> dict[str, Any]:
    """Return Inductor's options for a device.

    On the CPU the code between kernels is C++, too: a step of a small batch then takes three
    quarters of the time. On a GPU that would need the headers of CUDA.
    """
    on_cpu = device is None or device.type == "cpu"
    if not on_cpu:
        return {}
    bits = VECTORS.get(torch.backends.cpu.get_cpu_capability())
    return {"cpp_wrapper": True, "size_asserts": False, "cpp.simdlen": bits}


def compiler_errors() -> tuple[type[Exception], ...]:
    """Return the errors of torch's compiler, from private modules that a later torch may move."""
    from torch._dynamo.exc import TorchDynamoException
    from torch._inductor.exc import CppCompileError, InductorError

    # CppCompileError: of a compiler that is there, but refuses the processor's code.
    return TorchDynamoException, InductorError, CppCompileError


class Compiled:
    """A function compiled at its first call; where there is no compiler, the plain function.

    What the object of a method keeps under the names of :data:`CONSTANT` must not change between
    calls, but for the values of its tensors.

    Args:
        function: what to compile, for one size of its arguments.
        what: its name in the line of the log that says that it is not compiled.
        compiled: False for the plain function.
        device: of its tensors; None: the CPU.
    """

    errors: Any = staticmethod(compiler_errors)  # for which the plain function is used

    def __init__(
        self,
        function: Callable[..., Any],
        what: str,
        compiled: bool,
        device: torch.device | None = None,
    ) -> None:
        self.plain, self.what = function, what
        self.function = self._made(device) if compiled else function
        if compiled:
            logging.getLogger(CACHE_LOG).setLevel(logging.ERROR)

    def _made(self, device: torch.device | None) -> Callable[..., Any]:
        # One graph for each size: a graph for any size would be slower.
        return compile(self.plain, dynamic=False, **compile_settings(device))

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        if self.function is self.plain:
            return self.plain(*arguments)
        try:
            return self.function(*arguments)
        except self.errors() as error:
            log.info("not compiling %s: %s", self.what, str(error).strip().splitlines()[0])
            self.function = self.plain
            return self.plain(*arguments)


class Traced(Compiled):
    """A function of tensors alone, compiled at its first call for their shapes and strides.

    Nothing is checked before later calls, which takes four times as long as a step of 128 episodes:
    what the function keeps must not change. Where it cannot be compiled, it is called as it is.

    Args:
        function: maps tensors to a sequence of tensors.
        what: its name in the line of the log that says that it is not compiled.
        compiled: False for the plain function.
    """

    # Of many kinds; the plain function raises its own anew.
    errors: Any = staticmethod(lambda: (Exception,))

    def _made(self, device: torch.device | None) -> Callable[..., Any]:
        return self._first_call

    def _first_call(self, *tensors: Tensor) -> Sequence[Tensor]:
        # Here, since a later torch may lack some.
        from torch._guards import TracingContext, tracing
        from torch._subclasses import FakeTensorMode
        from torch.fx.experimental.proxy_tensor import make_fx
        from torch.fx.experimental.symbolic_shapes import ShapeEnv

        # Graphs traced without symbols of shapes are not kept for later processes.
        context = TracingContext(FakeTensorMode(shape_env=ShapeEnv()))
        # What remains of loops after whole vectors is mostly nothing, but a third of all kernels.
        rest = {"cpp.enable_loop_tail_vec": bool(tensors[0].numel() % LONGEST_VECTOR)}
        own = options(tensors[0].device) | rest
        with torch.no_grad(), tracing(context), uncollected():
            with TensorsOnly():
                graph = make_fx(self.plain)(*tensors)
            for node in graph.graph.nodes:  # other strides than in this trace may need a copy
                if node.target is torch.ops.aten.view.default:
                    node.target = torch.ops.aten.reshape.default
            graph.recompile()
            compiled = torch._inductor.compile(graph, list(tensors), own)
        results: Sequence[Tensor] = compiled(*tensors)
        self.function, self.errors = compiled, tuple  # errors of later calls are no compiler's
        return results


def _checked(guards: Sequence[Any]) -> list[bool]:
    """Return which of a graph's guards to check before each use.

    Pieces do not change (:mod:`lcc_rl.envs.checks` refuses those that do); to check a thousand
    settings of them takes as long as a step of a small batch. Arguments, the policy, and whether
    gradients are kept are checked.
    """
    return [
        not guard.is_global and not any(name in guard.name for name in CONSTANT) for guard in guards
    ]


def compile_settings(device: torch.device | None) -> dict[str, Any]:
    """Return settings of ``torch.compile`` for functions of an environment.

    Apart from other objects' compilations of the same code, whose guards would be tried first and
    count towards the compiler's limit of graphs. New at each call: torch takes entries out.
    """
    return {"isolate_recompiles": True, "options": options(device) | {"guard_filter_fn": _checked}}
