"""A picture of a moment of an episode: the screen, the player's action and its estimates."""

from collections.abc import Sequence
from functools import cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gvz.actions import action_buttons, action_mask
from gvz.core.env_config import EnvConfig
from gvz.evaluation.playback import SCREEN_HEIGHT, SCREEN_WIDTH, Moment
from gvz.evaluation.trained import Values
from gvz.scenarios.base import Task

HEAD_HEIGHT, FOOT_HEIGHT, SIDE_WIDTH = 46, 120, 440
WIDTH, HEIGHT = SCREEN_WIDTH + SIDE_WIDTH, HEAD_HEIGHT + SCREEN_HEIGHT + FOOT_HEIGHT
"""of the picture, pixels; both even, as H.264 wants them"""

Colour = tuple[int, int, int]
Box = tuple[float, float, float, float]

BACKGROUND: Colour = (18, 20, 24)
LINE: Colour = (58, 62, 70)
TEXT: Colour = (232, 234, 238)
FAINT: Colour = (150, 156, 166)
ACCENT: Colour = (255, 184, 77)
BAR: Colour = (92, 124, 168)
GOOD: Colour = (110, 200, 120)
BAD: Colour = (236, 102, 92)
LEVEL_COLOURS: Sequence[Colour] = ((235, 235, 235), (140, 220, 140), (230, 220, 110), (240, 165, 80), (240, 100, 90))
"""by the task's level"""

MARGIN, NOTE_HEIGHT = 16, 18


class Panel:
    """Draws the moments of one episode, in their order."""

    def __init__(self, player: str, task: Task, env: EnvConfig, notes: Sequence[str] = ()):
        """`player` is a name; `env` is what it plays in; `notes` are lines for the lower right corner."""
        self._task = task
        held, mask = action_buttons(task.scenario, env.action_set), action_mask(task.scenario, env.action_set)
        self._actions = {a: _action_name(held[a]) for a, allowed in enumerate(mask) if allowed}
        self._bound = task.scenario.upper_bound(env.profile)
        self._timeout = task.scenario.timeout_frames(env.profile)
        self._notes = notes
        self._value_range = (np.inf, -np.inf)
        self._timeline: list[tuple[int, float | None, float]] = []
        self._reward = 0.0
        self._picture = Image.new("RGB", (WIDTH, HEIGHT), BACKGROUND)
        self._draw = ImageDraw.Draw(self._picture)
        self._draw_head(player)

    def draw(self, moment: Moment) -> Image.Image:
        """The picture of a moment; it is drawn over with the next one."""
        self._picture.paste(Image.fromarray(moment.screen), (0, HEAD_HEIGHT))
        if moment.terminated or moment.truncated:
            self.announce("died" if moment.terminated else "time is up")
        rewarded = moment.reward - self._reward
        if moment.decided or rewarded:
            value = None if moment.values is None else moment.values.value
            self._timeline.append((moment.frames, value, rewarded))
            self._reward = moment.reward
            self._draw_side(moment)
        self._draw_foot(moment)
        return self._picture

    def _draw_head(self, player: str) -> None:
        task, middle = self._task, HEAD_HEIGHT / 2
        self._text((MARGIN, middle), task.scenario.title, 20, TEXT, "lm")
        x = MARGIN + _font(20).getlength(task.scenario.title) + 14
        self._text((x, middle), f"level {task.level}", 16, LEVEL_COLOURS[task.level], "lm")
        x += _font(16).getlength(f"level {task.level}") + 14
        size = _fitting(task.name, 16, SCREEN_WIDTH - x)
        self._text((x, middle), task.name, size, FAINT, "lm")
        size = _fitting(player, 16, SIDE_WIDTH - 2 * MARGIN)
        self._text((SCREEN_WIDTH + MARGIN, middle), player, size, TEXT, "lm")

    def announce(self, text: str) -> Image.Image:
        """The picture with a line of text over the game."""
        x, y = SCREEN_WIDTH / 2, HEAD_HEIGHT + SCREEN_HEIGHT / 3
        half = max(110, _font(26).getlength(text) / 2 + 20)
        self._draw.rounded_rectangle((x - half, y - 26, x + half, y + 26), 8, BACKGROUND)
        self._text((x, y), text, 26, ACCENT, "mm")
        return self._picture

    def _draw_side(self, moment: Moment) -> None:
        self._draw.rectangle((SCREEN_WIDTH, HEAD_HEIGHT, WIDTH, HEIGHT), BACKGROUND)
        left, right = SCREEN_WIDTH + MARGIN, WIDTH - MARGIN
        y = self._draw_actions(moment, (left, HEAD_HEIGHT, right, 0))
        if moment.values is not None and moment.values.probabilities is not None and moment.action is not None:
            y = self._draw_returns(moment.values, moment.action, (left, y + 12, right, 0))
        self._draw_rewards(moment, (left, y + 12, right, HEIGHT - NOTE_HEIGHT * len(self._notes)))
        for n, note in enumerate(reversed(self._notes)):
            self._text((left, HEIGHT - 8 - NOTE_HEIGHT * n), note, 13, FAINT, "ld")

    def _draw_actions(self, moment: Moment, box: Box) -> float:
        """A line an action that the scenario allows, the held one marked, with its value or probability if it has one.

        Returns where it ends.
        """
        left, y, right, _ = box
        caption, values, (low, high) = self._estimates(moment.values)
        self._caption((left, y), caption)
        y += 22
        row = min(24, 200 // len(self._actions))
        size = min(15, row - 3)
        name_width = min(220, max(_font(size).getlength(name) for name in self._actions.values()))
        bar_left, bar_right = left + 14 + name_width + 10, right - 62
        for action, name in self._actions.items():
            middle = y + row / 2
            held = action == moment.action
            colour = ACCENT if held else FAINT
            if held:
                self._draw.ellipse((left, middle - 4, left + 8, middle + 4), ACCENT)
            self._text((left + 14, middle), name, _fitting(name, size, 220), TEXT if held else FAINT, "lm")
            if values is not None:
                at = bar_left + (values[action] - low) / (high - low) * (bar_right - bar_left)
                self._draw.rectangle((bar_left, y + 3, bar_right, y + row - 4), LINE)
                self._draw.rectangle((bar_left, y + 3, max(at, bar_left), y + row - 4), ACCENT if held else BAR)
                self._text((right, middle), f"{values[action]:.3f}", size, colour, "rm")
            y += row
        return y

    def _estimates(self, values: Values | None) -> tuple[str, np.ndarray | None, tuple[float, float]]:
        """What the bars show: a caption, a number for each action, and the range of the bars.

        That of action values is a little wider than all so far, so that moments can be compared.
        """
        if values is None:
            return "action", None, (0.0, 1.0)
        if values.policy is not None:
            return "action, probability", values.policy, (0.0, 1.0)
        assert values.q_values is not None
        low, high = self._value_range
        shown = values.q_values[list(self._actions)]
        self._value_range = low, high = min(low, float(shown.min())), max(high, float(shown.max()))
        room = max(0.1 * (high - low), 1e-3)
        return "action, value (discounted reward to come)", values.q_values, (low - room, high + room)

    def _draw_returns(self, values: Values, action: int, box: Box) -> float:
        """The distribution of the held action's return as bars. Returns where it ends."""
        assert values.q_values is not None
        assert values.probabilities is not None
        assert values.atoms is not None
        left, y, right, _ = box
        name = self._actions.get(action, _action_name(()))  # one that is forbidden holds nothing
        self._caption((left, y), f"return of {name}, probability")
        masses, atoms = values.probabilities[action], values.atoms
        top, bottom = y + 24, y + 24 + (110 if len(self._actions) <= 6 else 70)
        width = (right - left) / len(atoms)
        scale = (bottom - top) / max(float(masses.max()), 0.1)
        self._text((right, top - 13), f"highest {masses.max():.2f}", 12, FAINT, "rm")
        for n, mass in enumerate(masses):
            x = left + n * width
            self._draw.rectangle((x, bottom - mass * scale, x + width - 2, bottom), BAR)
        self._draw.line((left, bottom + 1, right, bottom + 1), LINE)
        mean = left + (values.q_values[action] - atoms[0]) / (atoms[-1] - atoms[0]) * (right - left - width) + width / 2
        self._draw.line((mean, top - 4, mean, bottom), ACCENT, 2)
        self._text((left, bottom + 12), f"{atoms[0]:.1f}", 12, FAINT, "lm")
        self._text((right, bottom + 12), f"{atoms[-1]:.1f}", 12, FAINT, "rm")
        if left + 50 < mean < right - 50:
            self._text((mean, bottom + 12), f"mean {values.q_values[action]:.2f}", 12, ACCENT, "mm")
        return bottom + 22

    def _draw_rewards(self, moment: Moment, box: Box) -> None:
        left, y, right, bottom = box
        self._caption((left, y), "reward so far")
        y += 22
        row = min(22, (bottom - y - 10) // (len(moment.reward_components) + 1))
        size = min(15, row - 3)
        for name, value in moment.reward_components.items():
            colour = GOOD if value > 0 else BAD if value < 0 else FAINT
            self._text((left + 14, y + row / 2), name.replace("_", " "), size, FAINT, "lm")
            self._text((right, y + row / 2), f"{value:+.2f}" if value else "0", size, colour, "rm")
            y += row
        self._draw.line((left, y + 2, right, y + 2), LINE)
        self._text((left + 14, y + 4 + row / 2), "sum", size, TEXT, "lm")
        self._text((right, y + 4 + row / 2), f"{moment.reward:+.2f}", size, TEXT, "rm")

    def _draw_foot(self, moment: Moment) -> None:
        top = HEAD_HEIGHT + SCREEN_HEIGHT
        self._draw.rectangle((0, top, SCREEN_WIDTH, HEIGHT), BACKGROUND)
        self._text((MARGIN, top + 40), f"{moment.score:g}", 36, TEXT, "lm")
        x = MARGIN + _font(36).getlength(f"{moment.score:g}") + 10
        self._text((x, top + 45), f"of {self._bound:g} {self._task.scenario.metric.replace('_', ' ')}", 15, FAINT, "lm")
        percent = f"{100 * moment.score / self._bound:.1f} %    tic {moment.frames} of {self._timeout}"
        self._text((MARGIN, top + 84), percent, 15, FAINT, "lm")
        self._draw_timeline(moment, (330, top + 12, SCREEN_WIDTH - MARGIN, HEIGHT - 12))

    def _draw_timeline(self, moment: Moment, box: Box) -> None:
        """Over the episode's time: the value as a line, and below it rewards, up and down."""
        left, top, right, bottom = box
        scale = (right - left) / self._timeout
        now = left + moment.frames * scale
        self._draw.line((now, top, now, bottom), FAINT)
        points = [(left + frames * scale, value) for frames, value, _ in self._timeline if value is not None]
        if points:
            self._draw_values(points, (left, top, right, (top + bottom) / 2 - 6))
            top = (top + bottom) / 2 + 6
        middle = (top + bottom) / 2
        self._text((left - 10, middle), "reward", 13, FAINT, "rm")
        self._draw.line((left, middle, right, middle), LINE)
        largest = max((abs(reward) for _, _, reward in self._timeline), default=0.0)
        for frames, _, reward in self._timeline:
            x, height = left + frames * scale, abs(reward) / max(largest, 1e-6) * (bottom - top) / 2
            if height >= 2:  # not the small change of every decision
                y = middle - height if reward > 0 else middle
                self._draw.rectangle((x, y, x + 1, y + height), GOOD if reward > 0 else BAD)

    def _draw_values(self, points: Sequence[tuple[float, float]], box: Box) -> None:
        """A line through (x, value), from the lowest to the highest so far."""
        left, top, right, bottom = box
        low, high = min(value for _, value in points), max(value for _, value in points)
        scale = (bottom - top) / max(high - low, 1e-6)
        self._text((left - 10, top + 7), f"value {high:.2f}", 13, FAINT, "rm")
        self._text((left - 10, bottom - 5), f"{low:.2f}", 13, FAINT, "rm")
        self._draw.line((left, bottom, right, bottom), LINE)
        if len(points) > 1:
            self._draw.line([(x, bottom - (value - low) * scale) for x, value in points], ACCENT, 2)

    def _caption(self, at: tuple[float, float], text: str) -> None:
        self._text((at[0], at[1] + 10), text, 13, FAINT, "lm")

    def _text(self, at: tuple[float, float], text: str, size: float, colour: Colour, anchor: str) -> None:
        self._draw.text(at, text, colour, _font(size), anchor)


def _action_name(buttons: Sequence[str]) -> str:
    return "+".join(buttons).replace("_", " ").lower() or "nothing"


@cache
def _font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _fitting(text: str, size: float, width: float) -> float:
    """The font size, at most `size`, in which a text is no wider than `width` pixels."""
    while size > 6 and _font(size).getlength(text) > width:
        size -= 1
    return size
