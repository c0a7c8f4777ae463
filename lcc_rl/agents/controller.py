"""A controller as a policy."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch

from lcc_rl.errors import ConfigError, require_positive
from lcc_rl.functional.pattern import MAX_ACCELERATION
from lcc_rl.pieces.base import ACTION, NEXT, root_key
from lcc_rl.pieces.controllers import Controller


class ControllerPolicy(TensorDictModuleBase):
    """A controller as a policy: writes its command as the action.

    The action, ``("automated", "action")``, ``[*batch, A, 1]``, is the command divided by the
    acceleration of action 1, clamped to [−1, 1].

    Args:
        controller: a controller of the automated vehicles without memory.
        max_acceleration: acceleration of action 1 in the environment [m/s²].

    Raises:
        ConfigError: if the controller has a memory.
    """

    def __init__(self, controller: Controller, max_acceleration: float = MAX_ACCELERATION) -> None:
        require_positive("policy.max_acceleration", max_acceleration)
        if len(controller.targets) > 1 or any(key[0] == NEXT for key in controller.in_keys):
            raise ConfigError(
                f"{type(controller).__name__} remembers entries, which only an environment keeps; "
                "use it as scenario.controllers.automated"
            )
        self.in_keys = [root_key(key) for key in controller.in_keys]
        self.out_keys = [ACTION]
        super().__init__()
        self.controller, self.max_acceleration = controller, max_acceleration

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        command = self.controller.computed([tensordict.get(key) for key in self.in_keys])
        return tensordict.set(ACTION, (command / self.max_acceleration).clamp(-1.0, 1.0))
