"""What is not a number ends an evaluation or a training, with the entry, episode and step named."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from torch import Tensor

from lcc_rl.errors import Diverged
from lcc_rl.functional.finite import any_lost
from lcc_rl.functional.pattern import AUTOMATED, HUMAN
from lcc_rl.pieces.base import SEED, STEP, Key, Piece
from lcc_rl.pieces.leader import PROFILE, NGSIMLeader

ACTION = (AUTOMATED, "action")
DRIVER = (HUMAN, "driver")
EPISODE = (PROFILE, DRIVER, SEED, STEP)  # what tells episodes apart


class Written(NamedTuple):
    """An entry, its values ``[*batch, …]``, and the piece that wrote it; None for the policy."""

    key: Key
    value: Tensor
    writer: Piece | None = None

    def __str__(self) -> str:
        writer = "the policy" if self.writer is None else type(self.writer).__name__
        return f"{'.'.join(self.key)}, written by {writer},"


def check_moment(
    written: Sequence[Written],
    moment: Mapping[Key, Tensor],
    running: Tensor,
    pieces: Iterable[Piece] = (),
    who: str = "",
) -> bool:
    """Check that what was written at a step of a batch of episodes are numbers.

    Args:
        written: the entries in the order in which they were written.
        moment: entries that tell the episodes apart: their step, profile, drivers and seed.
        running: whether each episode runs, ``[*batch, 1]``; what follows its end does not count.
        pieces: the environment's; the leader's names the profiles.
        who: who drives, for the message.

    Returns:
        Whether an entry of an episode that is over is not a number.

    Raises:
        Diverged: naming entry, value, step and episode.
    """
    if not any_lost(entry.value for entry in written):
        return False
    lost = False
    for entry in written:
        rows = entry.value.detach().reshape(running.numel(), -1)
        bad = ~rows.isfinite().all(-1)
        lost = lost or bool(bad.any())
        places = (bad & running.flatten()).nonzero().flatten().tolist()
        if places:
            number = rows[places[0]][~rows[places[0]].isfinite()][0].item()
            step = int(moment[STEP].flatten()[places[0]])
            where = f"{who}: {entry}" if who else str(entry)
            raise Diverged(
                f"{where} is {number} at step {step} of {episode_name(moment, places[0], pieces)}"
            )
    return lost


def episode_name(moment: Mapping[Key, Tensor], place: int, pieces: Iterable[Piece] = ()) -> str:
    """Name an episode of a batch by its leader's profile, its drivers and its seed.

    Args:
        moment: entries of the batch, ``[*batch, …]``; those that it lacks are left out.
        place: place of the episode in the batch, flattened.
        pieces: the environment's; the leader's names the profiles.
    """
    count = moment[STEP].numel()
    known = {
        key: moment[key].reshape(count, -1)[place].tolist() for key in EPISODE if key in moment
    }
    parts = []
    if PROFILE in known:
        names = [piece.names for piece in pieces if isinstance(piece, NGSIMLeader)]
        profile = known[PROFILE][0]
        parts.append(f"profile {names[0][profile] if names else profile}")
    if DRIVER in known:
        parts.append(f"driver {', '.join(map(str, known[DRIVER]))}")
    if SEED in known:
        parts.append(f"seed {known[SEED][0]}")
    return f"episode {place}" + (f" ({', '.join(parts)})" if parts else "")
