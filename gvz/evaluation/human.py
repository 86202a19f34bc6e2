"""A person as a player: which keys stand for which buttons, and which action a set of pressed keys is."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from gvz.core.errors import ConfigError

if TYPE_CHECKING:
    from gvz.env import DoomEnv
    from gvz.observation import Observation
    from gvz.viewer import Window

KEYS: Mapping[str, tuple[str, ...]] = {
    "ATTACK": ("space", "left ctrl"),
    "USE": ("e", "return"),
    "SPEED": ("left shift", "right shift"),
    "MOVE_FORWARD": ("up", "w"),
    "MOVE_BACKWARD": ("down", "s"),
    "TURN_LEFT": ("left", "a"),
    "TURN_RIGHT": ("right", "d"),
    "MOVE_LEFT": ("a", "left"),
    "MOVE_RIGHT": ("d", "right"),
}
"""button -> pygame's names of its keys. A game takes the second one only if it is not the first key of another of its
buttons: arrows and letters do the same, except where the agent both turns and steps aside."""


def key_buttons(actions: Sequence[Sequence[str]]) -> dict[str, str]:
    """Key -> button, for all buttons that some action holds.

    Args:
        actions: the buttons of each action, `DoomEnv.action_meanings`.

    Raises:
        ConfigError: a button that no key stands for.
    """
    buttons = list(dict.fromkeys(button for held in actions for button in held))
    if unknown := [button for button in buttons if button not in KEYS]:
        raise ConfigError(f"no key stands for {', '.join(unknown)}; add it to KEYS in gvz/evaluation/human.py")
    first = {KEYS[button][0]: button for button in buttons}
    return {KEYS[button][1]: button for button in buttons} | first


def nearest_action(actions: Sequence[Sequence[str]], pressed: Sequence[str]) -> int:
    """The action that differs from the pressed buttons by the fewest buttons.

    Of actions that differ by equally many, the one with the button that was pressed last: with both turns pressed the
    agent turns to where it was turned last.

    Args:
        actions: the buttons of each action.
        pressed: buttons, the one pressed last at the end.
    """

    def rank(action: int) -> tuple[int, list[int]]:
        held = set(actions[action])
        latest_first = sorted((n for n, button in enumerate(pressed) if button in held), reverse=True)
        return -len(held ^ set(pressed)), latest_first

    return max(range(len(actions)), key=rank)


class HumanPlayer:
    """Whoever sits before a window. What is pressed when a decision is due, or was since the last one, is held."""

    def __init__(self, window: "Window"):
        self._window = window

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        self._actions = env.action_meanings
        self._buttons = key_buttons(env.action_meanings)

    def act(self) -> int:
        pressed = [self._buttons[key] for key in self._window.pressed_keys() if key in self._buttons]
        return nearest_action(self._actions, list(dict.fromkeys(reversed(pressed)))[::-1])

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        """The window shows it."""


def key_help(actions: Sequence[Sequence[str]]) -> list[str]:
    """A line for each button that has keys: "turn left: left, a"."""
    by_button: dict[str, list[str]] = {}
    for key, button in key_buttons(actions).items():
        by_button.setdefault(button, []).insert(0, key)
    return [f"{button.replace('_', ' ').lower()}: {', '.join(keys)}" for button, keys in by_button.items()]
