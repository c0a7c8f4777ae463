"""Export of policies and rules as ONNX, PyTorch's ``.pt2``, C or a page of the ring road.

An exported program maps the measurements of a vehicle in SI units to its acceleration. It contains
the scales of the observation, the network and the safety filter, if there is one. The program of a
policy with a memory also reads and returns the memory.
"""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

from lcc_rl.config import load
from lcc_rl.config.words import key_of, with_variant
from lcc_rl.errors import needing, require, require_known
from lcc_rl.evaluation.foreign import network_of
from lcc_rl.evaluation.named import is_policy, one_of
from lcc_rl.interfaces.c_code import c_code
from lcc_rl.interfaces.driver import Driver
from lcc_rl.interfaces.exported import DrivingProgram, Safety, described_input, program
from lcc_rl.interfaces.onnx_policy import MAKES, TAKES
from lcc_rl.interfaces.ring_page import ring_page
from lcc_rl.io.atomic import atomic_path, new_file
from lcc_rl.pieces.base import SEED
from lcc_rl.pieces.controllers import Controller
from lcc_rl.runs.arguments import Arguments
from lcc_rl.version import __version__


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
    ``next_memory``. C code (``.c``) is one function ``step(state, memory)`` in C99. Names, units
    and meanings of the inputs are in the file's metadata under ``lcc_rl`` as JSON. A page
    (``.html``) shows the ring road with the policy in any browser, see
    :func:`lcc_rl.interfaces.ring_page.ring_page`.

    Args:
        policy: a run folder, a policy file, or ``pretrained/<name>``; a rule by name, with steps of
            0.1 s (``"idm_acc_filtered"``); a controller as for :func:`lcc_rl.simulate`; or a model
            of stable-baselines3 or a torch module from observations ``[batch, n]`` to actions
            ``[batch, 1]``.
        path: the file to write.
        trust: modules outside this package that the policy may name.
        variant, overrides: environment in which a model or module was trained; for a page the
            overrides are settings of its ring, for a trained policy's program those of its filter
            and of the car, such as ``safety.margin=2``, ``limits.max_braking=6``.
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
    return _written(policy, path, trust, variant, overrides, normalize, safety, limits)[0]


def _written(
    policy: Any,
    path: str | Path,
    trust: Sequence[str],
    variant: str = "alcc",
    overrides: Sequence[str] = (),
    normalize: Any = None,
    safety: Safety = None,
    limits: Mapping[str, float] | None = None,
) -> tuple[Path, list[str]]:
    """Write the file, see :func:`export`; return its path and the inputs of its program."""
    path = new_file(path, "name")
    require_known("ending", path.suffix, [*EXPORTERS, PAGE])
    page = path.suffix == PAGE
    network = None if isinstance(policy, Controller) else network_of(policy, normalize)
    name, spec = one_of(policy) if network is None else (type(policy).__name__, network)
    cfg = None if network is None else load("train", with_variant(variant, overrides))
    rule = cfg is None and not is_policy(spec)
    text = f"{name}: a page ({PAGE}) needs a run or a policy file, and has its own filter"
    require(not page or (cfg is None and not (safety or limits or rule)), text)
    if cfg is None and not page and overrides:
        own = "settings of a controller are in its yaml file or, in Python, its object"
        text = f"{' '.join(overrides)}: a program ({path.suffix}) takes safety.… and limits.…, "
        text += f"no road; {own}" if rule else "no road"
        prefixes = ("safety.", "limits.")
        require(all(key_of(override).startswith(prefixes) for override in overrides), text)
        text = "overrides: safety.… and limits.… are given as arguments, too"
        require(safety is None and limits is None, text)
        changed: Any = OmegaConf.to_container(OmegaConf.from_dotlist(list(overrides)))
        safety, limits = changed.get("safety"), changed.get("limits")
    names: list[str] = []
    if page:
        content = ring_page(policy, trust, overrides).encode()
    else:
        changes = (safety, limits)
        module = _rule(policy, trust, *changes) if rule else program(spec, trust, cfg, *changes)
        content, names = EXPORTERS[path.suffix](module, name), module.names
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    return path, names


def _rule(given: Any, trust: Sequence[str], safety: Safety, limits: Any) -> DrivingProgram:
    """Return the program of a rule with steps of 0.1 s."""
    driver = Driver(given, 0.1, trust, safety, limits=limits)
    noisy = SEED in driver.program.kept
    require(not noisy, f"{driver.name} draws noise from seeds: it cannot be exported")
    return driver.program


def described(module: DrivingProgram, name: str) -> str:
    """Return the description of a program as JSON: names, units and stand-ins of its inputs."""
    inputs = [described_input(name)._asdict() for name in module.names]
    for column in inputs:
        if column["name"] in module.stand_ins:
            column["stand_in"] = str(module.stand_ins[column["name"]])
    about: dict[str, Any] = {"policy": name, "lcc_rl": __version__, "inputs": inputs}
    about["time_step_s"] = module.controller.time_step
    about |= {"output": "acceleration [m/s²]", "filter": module.safety is not None}
    return json.dumps(about, ensure_ascii=False)


def _program(module: DrivingProgram) -> Any:
    widths = [len(module.names), module.width][: 1 + (module.width > 0)]
    batch = dict(zip(TAKES, [{0: torch.export.Dim("batch", min=1)}] * len(widths), strict=False))
    examples = tuple(torch.ones(2, width) for width in widths)
    return torch.export.export(module, examples, dynamic_shapes=batch)


def _as_pt2(module: DrivingProgram, name: str) -> bytes:
    buffer = BytesIO()
    torch.export.save(_program(module), buffer, extra_files={"lcc_rl": described(module, name)})
    return buffer.getvalue()


def _as_onnx(module: DrivingProgram, name: str) -> bytes:
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
    onnx.helper.set_model_props(proto, {"lcc_rl": described(module, name)})
    content: bytes = proto.SerializeToString()
    return content


def _as_c(module: DrivingProgram, name: str) -> bytes:
    return c_code(module, described(module, name)).encode()


PAGE = ".html"
EXPORTERS = {".onnx": _as_onnx, ".pt2": _as_pt2, ".c": _as_c}


def main(arguments: Sequence[str] | None = None) -> int:
    """Export the policy of a command line."""
    parser = Arguments(description="Export a policy for other software.")
    parser.add_argument("policy", help="run folder, policy.pt, pretrained/<name> or a rule")
    parser.add_argument("path", help="file: a program (.onnx, .pt2, .c) or a page (.html)")
    parser.add_trust()
    text = "of a page's ring (drivers=i80), of a program (safety.margin=2 limits.max_braking=6)"
    parser.add_argument("settings", nargs="*", default=[], help=text)
    options = parser.parse_args(arguments)
    args = options.policy, options.path, options.trust
    path, names = _written(*args, overrides=options.settings)
    if path.suffix == PAGE:
        print(f"{path}: the ring road in the browser, with {options.policy}")
        return 0
    for column in map(described_input, names):
        print(f"  {column.name} [{column.unit}]: {column.meaning}")
    print(f"{path}: maps these inputs, in this order, to the acceleration [m/s²]")
    return 0
