"""The grid of times that all parts of a plant share, and how far they have come on it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from fitctl.model import air_path
from fitctl.model.compiled import compiled
from fitctl.model.plant_constants import AirConstants

Floats = NDArray[np.float64]
BLOCK_NODES = 50  # of the air path, drawn at a time


class Timeline:
    """Advances the parts of a plant together, each after those that act on it.

    Parameters
    ----------
    step_s : float
    history_s : float
        How long parts keep where they were.

    Attributes
    ----------
    steps : int
        Since the start.
    kept : int
        Steps that parts keep.
    block_steps : int
        Steps for which parts draw their air at a time.
    """

    def __init__(self, step_s: float, history_s: float) -> None:
        self.step_s = step_s
        self.steps = 0
        self.kept = max(1, round(history_s / step_s))
        self.block_steps = BLOCK_NODES * air_path.steps_per_node(step_s)
        self._room_until = 0
        self._parts: list[Part] = []

    def add(self, part: Part) -> None:
        """Advance one more part, after those that were added before it."""
        self._parts.append(part)

    @property
    def time_s(self) -> float:
        """The plant's own time; it starts at zero."""
        return self.steps * self.step_s

    @property
    def oldest_s(self) -> float:
        """The earliest time that the history still holds."""
        return max(1, self.steps - self.kept + 1) * self.step_s

    def advance(self, time_s: float) -> None:
        """Go on to the grid time nearest to `time_s`; a time already reached changes nothing."""
        wanted = round(time_s / self.step_s)
        while self.steps < wanted:
            if self.steps == self._room_until:
                self._make_room()
            until = wanted if wanted < self._room_until else self._room_until
            for part in self._parts:
                part.step(self.steps, until - self.steps)
            self.steps = until

    def _make_room(self) -> None:
        """For steps up to the end of the air drawn or of what is kept, whichever comes first."""
        air_row, kept_row = self.steps % self.block_steps, self.steps % self.kept
        if air_row == 0:
            for part in self._parts:
                part.begin_block()
        self._room_until = self.steps + min(self.block_steps - air_row, self.kept - kept_row)

    def row(self, time_s: float) -> int:
        """Where parts keep the grid time nearest to `time_s`, which is reached.

        Raises
        ------
        ValueError
            If that is before what the history still holds.
        """
        self.advance(time_s)
        if self.steps == 0:
            self.advance(self.step_s)
        step = max(1, round(time_s / self.step_s))
        if step <= self.steps - self.kept:
            msg = f"the plant's history begins at {self.oldest_s:.3f} s, asked for {time_s:.3f} s"
            raise ValueError(msg)
        return (step - 1) % self.kept

    def rows(self, start_s: float, end_s: float) -> NDArray[np.int64]:
        """Where parts keep the grid times of a span; what is older, or not yet reached, is left out."""
        last = round(min(end_s, self.time_s) / self.step_s)
        oldest = self.steps - self.kept + 1
        first = max(1, oldest, round(min(start_s, self.time_s + self.step_s) / self.step_s))
        return (np.arange(first, last + 1) - 1) % self.kept


class Part(ABC):
    """One part of a plant.

    Parameters
    ----------
    timeline : Timeline
        Advances it.

    Attributes
    ----------
    advance : callable
        :meth:`Timeline.advance`, of the whole plant.
    """

    def __init__(self, timeline: Timeline) -> None:
        self.advance = timeline.advance
        self._timeline = timeline
        timeline.add(self)

    @abstractmethod
    def begin_block(self) -> None:
        """Draw what is random in the next `block_steps` steps."""

    @abstractmethod
    def step(self, first: int, steps: int) -> None:
        """Go on by some steps from the step `first`; neither block nor history ends within them."""

    @property
    def time_s(self) -> float:
        """The plant's own time; it starts at zero."""
        return self._timeline.time_s

    @property
    def oldest_s(self) -> float:
        """The earliest time that the history still holds."""
        return self._timeline.oldest_s


def pieces(from_nodes: Sequence[int], first: int) -> Iterator[tuple[int, int, int]]:
    """Epochs of the block of nodes that begins at `first`: number, and first and last node within the block.

    `from_nodes` says where each epoch begins; the first at 0.
    """
    ends = [*from_nodes[1:], first + BLOCK_NODES]
    for number, (from_node, to_node) in enumerate(zip(from_nodes, ends, strict=True)):
        begin, end = max(from_node - first, 0), min(to_node - first, BLOCK_NODES)
        if begin < end:
            yield number, begin, end


class Air:
    """Air paths of a batch of runs, block after block.

    Parameters
    ----------
    epochs : sequence of pair of int and AirConstants
        From which node on the air is like that; the first from 0.
    streams : list of list of Generator
        Of each run, and in it of each air path. One draw for each, so that a run is the same whichever others
        are beside it.
    motion : array, shape (block_steps, runs, paths, 2)
        Receives the motion; paths after the first are scaled to what a spot has of its own.
    """

    def __init__(
        self,
        epochs: Sequence[tuple[int, AirConstants]],
        streams: list[list[np.random.Generator]],
        motion: Floats,
    ) -> None:
        self._from_nodes = [from_node for from_node, _ in epochs]
        self._epochs = [constants for _, constants in epochs]
        self._streams = streams
        self._motion = motion
        self._nodes = 0
        started = [[random.standard_normal((2, 2)) for random in stream] for stream in streams]
        self._state = np.array(started) @ self._epochs[0].initial.T

    def draw(self) -> None:
        """The motion of the next block."""
        air_motion, steps = compiled(air_path.air_motion), len(self._epochs[0].weights)
        for number, begin, end in pieces(self._from_nodes, self._nodes):
            constants, rows = self._epochs[number], slice(begin * steps, end * steps)
            for run, randoms in enumerate(self._streams):
                for path, random in enumerate(randoms):
                    air_motion(
                        self._state[run, path],
                        random.standard_normal((end - begin, 2, 2)),
                        constants.transition,
                        constants.noise_gain,
                        constants.weights,
                        self._motion[rows, run, path],
                    )
        self._motion[:, :, 1:] *= self._epochs[0].relative
        self._nodes += BLOCK_NODES
