"""What a person at the terminal makes of a run: keys, Ctrl-C and answers become the run's commands.

Nobody at a terminal: Ctrl-C once ends the run after the shot in hand, and whatever suspends the run ends it with its error.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType

from acquire.capture_states import RunState
from acquire.events import Captured, Command, Continue, Event, Failed, Pause, Paused, PoseStarted, Redo, Skip, Skipped, Stop, Suspended
from measure.running_keys import Keyboard

_STANDING = (PoseStarted, Captured, Failed, Skipped)
"""The robot stands and nothing of the pose in hand would be lost."""

KEYS = "p pause, s skip, r redo, q end; Ctrl-C pauses, twice stops now"
_GO: Mapping[str, Command] = {"\n": Continue(), "\r": Continue(), "s": Skip(), "r": Redo(), "q": Stop()}


class Interrupts:
    """Ctrl-C once: the run pauses when the robot stands and the shot in hand is on disk. Twice: KeyboardInterrupt, it stops now."""

    def __init__(self, tell: Callable[[str], None], *, attended: bool) -> None:
        self.asked = False
        self.ended = False
        """Whether a Ctrl-C ended the run."""
        self._tell, self._attended = tell, attended

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Take SIGINT while the block runs."""
        former = signal.signal(signal.SIGINT, self._interrupted)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, former)

    def _interrupted(self, _number: int, _frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        self._tell(f"Ctrl-C: the run {'pauses' if self._attended else 'ends'} after this shot; once more stops the robot now")


class Operator:
    """Answers events. Poses that are not planned are asked about in any mode: nobody has driven there before."""

    def __init__(
        self, keys: Keyboard | None, interrupts: Interrupts, prompt: Callable[[str | None], None], *, step: bool, planned: Collection[str] = ()
    ) -> None:
        self._keys, self._interrupts, self._prompt, self._step = keys, interrupts, prompt, step
        self._planned = frozenset(planned)
        self._pause = self._end = False

    def command_at(self, event: Event) -> Command | None:
        """What was asked for, as soon as it can be done."""
        if isinstance(event, Suspended):
            return None if self._keys is None else self._ask(f"{event.cause}: put right? {_CHOICE}")
        if isinstance(event, Paused):
            return self._ask(f"paused: {_CHOICE}")
        pressed = self._pressed()
        if pressed is not None:
            return pressed
        if isinstance(event, _STANDING) and (self._pause or self._end or self._interrupts.asked):
            return self._at_rest()
        if isinstance(event, PoseStarted) and self._keys is not None and (self._step or event.pose.id not in self._planned):
            answer = self._ask(f"pose {event.pose.id}: Enter goes there, s skips it, r redoes the last, q ends the run:")
            return None if isinstance(answer, Continue) else answer
        return None

    def _pressed(self) -> Command | None:
        key = None if self._keys is None else self._keys.pressed()
        self._pause = self._pause or key == "p"
        self._end = self._end or key == "q"
        if self._step:
            return None  # a pose is skipped or taken again where its question is asked
        return Skip() if key == "s" else Redo() if key == "r" else None

    def _at_rest(self) -> Command:
        if self._end or self._keys is None:
            self._interrupts.ended = self._interrupts.asked
            return Stop()
        self._pause = self._interrupts.asked = False
        return Pause()

    def _ask(self, question: str) -> Command:
        if self._keys is None:
            return Stop()
        self._keys.forget()
        self._prompt(question)
        answer = self._keys.ask(_GO, self._interrupt_ends)
        self._prompt(None)
        return answer

    def _interrupt_ends(self) -> Command | None:
        """Ctrl-C at a question: the robot stands already, so the run ends."""
        if not self._interrupts.asked:
            return None
        self._interrupts.ended = True
        return Stop()


_CHOICE = "Enter goes on, s skips, r redoes the last, q ends the run:"


def state_name(state: RunState) -> str:
    """For the screen."""
    return state.value.upper() if state is RunState.PAUSED else state.value
