"""Defines scenario, attribute and task.

A scenario is data: a base map, a script template and their default `Content`. An attribute is the `Content` it changes.
A task is a scenario with a set of attributes. `gvz.scenarios.compiler` makes a map from a task.
"""

import dataclasses
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

from gvz.core.env_config import EnvConfig, Profile
from gvz.core.errors import TaskError, nearest
from gvz.scenarios.checks import check_scenario, graded_name
from gvz.scenarios.layout import Layout
from gvz.scenarios.map_set import PROCEDURAL, VARIED, MapSet
from gvz.scenarios.rewards import Reward, Rewarder, check_weights, return_range
from gvz.wad.udmf import UdmfMap


@dataclass(frozen=True, slots=True)
class Uniform:
    """A uniformly random number, ends included. The script draws it each time it evaluates the value."""

    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Toward:
    """A property that goes a share of the way from what the thing itself has to `value`."""

    value: float | Uniform
    share: float


@dataclass(frozen=True, slots=True)
class Chance:
    """A property that this share of the things get, drawn for each; the others have `otherwise`, or their own."""

    value: str
    share: float
    otherwise: str | None = None


class Period(int):
    """Tics after which something comes again; 0: it never comes. At a severity it comes so much more rarely."""


Value = bool | int | float | str | Uniform | Toward | Chance | tuple[str | float, ...]
"""A value in a script. int: ACS integer; float: fixed point; str: unchanged ACS expression; tuple: initializer of an
array, with quoted strings. Toward and Chance are for properties alone."""

BOOKKEEPING: Mapping[str, str] = MappingProxyType(
    {
        "PLAYER_KILLS": "USER1",  # enemies killed by the agent itself; KILLCOUNT also counts infighting
        "SPAWNED": "USER2",  # enemies, kits or other things to find that were put on the map so far
        "KITS_TAKEN": "USER3",  # kits, or keys
        "POISONS_TAKEN": "USER4",  # vials of poison, or other things that hurt
        "GOALS": "USER5",  # how often the agent did what the metric `goals` counts
        "STEPS_NEARER": "USER6",  # steps of 64 units by which the agent came nearer to a goal
        "MAP_MAGIC": "USER60",  # `CompiledTask.map_magic`: checks that the right map runs
    }
)
"""Variables that every compiled map has beside the engine's own -> ViZDoom game variable. Variables that a scenario
does not use stay 0. USERn is the script's `global int n`."""

Split = Literal["train1", "train4", "train8", "test"]
Suite = Literal["core", "extended"]
"""core: the four scenarios of the thesis, which published scores are of; extended: later ones"""
Metric = Literal["frames_alive", "kills", "goals"]

MAX_LEVEL = 4
"""Tasks of four or more attributes are level 4 (thesis 3.2: with more than three, difficulty hardly increases)."""


@dataclass(frozen=True, slots=True)
class Textures:
    """One texture name each for all walls, floors and ceilings. Walls may use flats; planes may use wall textures."""

    wall: str
    floor: str
    ceiling: str


@dataclass(frozen=True, slots=True)
class Blend:
    """A texture made of two: `over` covers `under` and is opaque by the share `opacity`."""

    under: str
    over: str
    opacity: float


@dataclass(frozen=True, slots=True)
class Thing:
    """An object on the map from the start. Position in map units; `type` is an editor number."""

    type: int
    x: float
    y: float
    tid: int = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class Content:
    """The contents of a map, or the part of them that a profile or an attribute changes."""

    base_wad: str | None = None
    """file name in vizdoom's scenarios directory"""
    textures: Textures | None = None
    things: Mapping[str, tuple[Thing, ...]] = field(default_factory=dict)
    """added things by base map (coordinates are valid on one map only)"""
    parameters: Mapping[str, Value] = field(default_factory=dict)
    """values of the `$names` of the scenario's script; an array `x` also defines its length, `num_x`"""
    entity: Mapping[str, Value] = field(default_factory=dict)
    """APROP name -> value, set on every enemy or kit when it spawns"""
    agent: Mapping[str, Value] = field(default_factory=dict)
    """APROP name -> value, set on the agent when it enters"""
    actors: Mapping[str, str] = field(default_factory=dict)
    """class name -> its DECORATE definition"""
    blends: Mapping[str, Blend] = field(default_factory=dict)
    """texture name -> what it is made of; other textures are those of Freedoom"""

    def overlaid(self, other: "Content") -> "Content":
        """This content, with every value that `other` sets replaced by that of `other`."""
        mappings = ("things", "parameters", "entity", "agent", "actors", "blends")
        return Content(
            base_wad=other.base_wad or self.base_wad,
            textures=other.textures or self.textures,
            **{name: {**getattr(self, name), **getattr(other, name)} for name in mappings},
        )

    def joined(self, other: "Content") -> "Content":
        """Like `overlaid`, but with the things of both."""
        base_wads = {**self.things, **other.things}
        things = {name: self.things.get(name, ()) + other.things.get(name, ()) for name in base_wads}
        return self.overlaid(dataclasses.replace(other, things=things))


@dataclass(frozen=True, kw_only=True, slots=True)
class Variety:
    """What may differ between the drawn maps of a scenario. `gvz.scenarios.looks` draws all but the layout."""

    entities: tuple[str, ...]
    """classes of the default task's enemies or kits"""
    entity_parameters: tuple[str, ...]
    """the script's parameters that name these classes"""
    max_decorations: int
    """most decorations of a map"""
    solid: bool = True
    """whether a decoration is as solid as Doom has it; else nothing stops steps, bullets or missiles"""
    keep_clear: Callable[[float, float], bool] | None = None
    """whether no decoration may stand at a place, map units: enemies stand there, or it would fill the screen.
    Walls and the agent's starts are kept clear in any case."""
    draw_layout: Callable[[random.Random, float], Layout]
    """f(rng, strength > 0): a map's geometry"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Attribute:
    """One visual modification of a scenario."""

    name: str
    groups: tuple[str, ...]
    """a task has at most one attribute of a group; each group counts one level"""
    content: Content
    levdoom: Content = field(default_factory=Content)
    """what replaces parts of `content` in profile levdoom"""
    aliases: tuple[str, ...] = ()
    """the thesis's shorter names in combined tasks ("fast+flying")"""
    not_drawn: tuple[str, ...] = ()
    """properties of entities that drawn maps with this attribute leave as they are, beside those that `content` sets"""


@dataclass(frozen=True, kw_only=True, repr=False)
class Scenario:
    """A map, an objective, a reward and buttons; the first extension point of the benchmark.

    Scenarios can be pickled. Two scenarios are equal if all their fields are equal, also across processes. A TaskError
    says what does not fit together (gvz.scenarios.checks).
    """

    id: str
    title: str
    suite: Suite = "extended"
    """what it is measured with; scores over several scenarios are of one suite"""
    content: Content
    """contents of the default task's map"""
    levdoom: Content = field(default_factory=Content)
    """what replaces parts of it in profile levdoom"""
    script: str
    """ACS source with `$names` (string.Template): `content.parameters`, and `$entity_properties`,
    `$agent_properties`, `$map_magic`, which the compiler fills in"""
    attributes: tuple[Attribute, ...]
    """if two attributes set the same value, the later one wins"""
    complete: tuple[str, ...]
    """attributes of the task `complete`: one of every group"""
    levdoom_tasks: Mapping[str, Content] = field(default_factory=dict)
    """exceptions in profile levdoom: task ("default", "gore+mossy_bricks", ...) -> the changes of its map"""
    tasks: tuple[str, ...]
    """the named tasks, in the thesis's order"""
    splits: Mapping[Split, tuple[str, ...]]
    """training sets of 1, 4 and 8 tasks, and the test set"""
    draw_map: Callable[[UdmfMap], None] | None = None
    """changes the base map in place, before textures and things are set"""
    variety: Variety | None = None
    """what its drawn maps may draw; None: it has none"""

    buttons: tuple[str, ...]
    combination_buttons: tuple[str, ...] | None = None
    """buttons that action set `combinations` combines; default: all"""
    game_variables: tuple[str, ...]
    """variables that the agent may see beside pixels"""
    metric: Metric
    render_weapon: bool
    timeouts: Mapping[Profile, int]
    upper_bounds: Mapping[Profile, float]
    """best possible score"""
    rewards: Mapping[str, Reward]

    def __post_init__(self) -> None:
        check_scenario(self)

    def __hash__(self) -> int:
        return hash(self.id)  # the other fields hold mappings

    def __repr__(self) -> str:
        return f"Scenario({self.id!r})"

    def timeout_frames(self, profile: Profile = "thesis") -> int:
        """Game tics after which an episode is truncated."""
        return self.timeouts[profile]

    def upper_bound(self, profile: Profile = "thesis") -> float:
        """Best possible score; divides a score to normalize it."""
        return self.upper_bounds[profile]

    def reward_weights(
        self, weights: Mapping[str, float] | None = None, profile: Profile = "thesis"
    ) -> dict[str, float]:
        """The weight of every reward component.

        Args:
            weights: component -> weight, instead of the profile's; other components keep the profile's weight. A name
                such as "seek_and_kill.moved" is of that scenario alone.
            profile: the profile of the other weights.

        Raises:
            ConfigError: an unknown component, or a weight that is not a finite number.
            TaskError: an unknown scenario in a name.
        """
        defaults = {n: r.levdoom if profile == "levdoom" else r.weight for n, r in self.rewards.items()}
        return defaults if weights is None else {**defaults, **check_weights(self._own(weights), defaults)}

    def _own(self, weights: Any) -> Any:
        """Without the weights of other scenarios, which are checked."""
        if not isinstance(weights, Mapping) or not any("." in str(name) for name in weights):
            return weights
        from gvz.tasks import scenario_named  # which imports this module

        own: dict[str, float] = {}
        for name, weight in sorted(weights.items(), key=lambda pair: "." in str(pair[0])):  # the own ones come last
            scenario, dot, component = str(name).rpartition(".")
            if dot and scenario != self.id:
                scenario_named(scenario).reward_weights({component: weight})
            else:
                own[component] = weight
        return own

    def make_rewarder(self, weights: Mapping[str, float] | None = None, profile: Profile = "thesis") -> Rewarder:
        """A rewarder for one game, with `reward_weights(weights, profile)`; raises the same errors."""
        return Rewarder({n: r.event for n, r in self.rewards.items()}, self.reward_weights(weights, profile))

    def return_range(self, env: EnvConfig, discount: float) -> tuple[float, float]:
        """(v_min, v_max): the range of discounted returns in this scenario's tasks; `discount` is of one decision.

        Raises:
            ConfigError: a weight of an unknown component.
        """
        weights = self.reward_weights(dict(env.reward_weights), env.profile)
        return return_range(self.rewards, weights, env, discount)

    def attribute(self, name: str) -> Attribute:
        """The attribute with this name or alias.

        Raises:
            TaskError: there is none; the message lists all attributes and names the nearest.
        """
        for attribute in self.attributes:
            if name == attribute.name or name in attribute.aliases:
                return attribute
        raise TaskError(
            f"scenario {self.id}: unknown attribute {name!r}"
            f"{nearest(name, [*(a.name for a in self.attributes), VARIED, PROCEDURAL])}; want {self.choices()}"
        )

    def choices(self) -> str:
        """Its attributes by group, for error messages."""
        groups: dict[str, list[str]] = {}
        for attribute in self.attributes:
            for group in attribute.groups:
                groups.setdefault(group, []).append(attribute.name)
        members = "; ".join(f"{group}: {', '.join(names)}" for group, names in groups.items())
        drawn = "" if self.variety is None else f", or {VARIED}, {VARIED}-<number of maps>, {PROCEDURAL}-<split>"
        return f"default, complete, or at most one of each group ({members}){drawn}"


@dataclass(frozen=True, slots=True)
class Task:
    """A scenario with a set of attributes, or with maps that are drawn. `gvz.tasks.parse_task` makes it from an id.

    Attributes:
        scenario: the scenario.
        attributes: canonical names, sorted.
        maps: drawn maps; an episode's seed says which is played. None: one map, that of the attributes. Maps of
            `varied` can have attributes, but not those of group `textures`, which are drawn.
        severities: (attribute, severity) pairs of attributes that are graded (gvz.scenarios.severity), sorted. Those
            left out have severity 1; an attribute given with severity 0 is left out altogether.

    Raises:
        TaskError: an unknown attribute, two of one group, a severity out of range or of an attribute that is not among
            them, or an attribute that such drawn maps cannot have.
    """

    scenario: Scenario
    attributes: tuple[str, ...] = ()
    maps: MapSet | None = None
    severities: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        if self.maps is not None and self.scenario.variety is None:
            raise TaskError(f"{self.scenario.id}: got {self.maps.name}, but the scenario has no variety; set it")
        if self.maps is not None and self.maps.split != VARIED and self.attributes:
            raise TaskError(
                f"{self.scenario.id}: got {self.maps.name} and {'+'.join(self.attributes)}, want one of them; "
                f"{VARIED!r} takes attributes"
            )
        found = [self.scenario.attribute(name) for name in self.attributes]
        if self.maps is not None and (drawn := [one.name for one in found if "textures" in one.groups]):
            raise TaskError(
                f"{self.scenario.id}: got {self.maps.name} and {drawn[0]}, but textures are drawn; leave one out"
            )
        taken: dict[str, str] = {}
        for attribute in found:
            for group in attribute.groups:
                if group in taken:
                    raise TaskError(
                        f"scenario {self.scenario.id}: {taken[group]} and {attribute.name} are both of group "
                        f"{group}; want {self.scenario.choices()}"
                    )
                taken[group] = attribute.name
        severities = {self.scenario.attribute(name).name: float(value) for name, value in self.severities}
        for name, severity in severities.items():
            if severity and name not in [one.name for one in found]:
                raise TaskError(f"{self.scenario.id}: got {name}={severity:g}, want {name} among the attributes, too")
            if not 0 <= severity <= 1 or round(severity, 3) != severity:  # the name gives three decimals back
                raise TaskError(
                    f"scenario {self.scenario.id}: got {name}={severity:g}, want a severity from 0 (as without it) to "
                    "1 (whole), with at most three decimals"
                )
        kept = sorted(attribute.name for attribute in found if severities.get(attribute.name) != 0)
        object.__setattr__(self, "attributes", tuple(kept))
        pairs = ((name, severities.get(name, 1.0)) for name in kept)
        object.__setattr__(self, "severities", tuple(pair for pair in pairs if pair[1] != 1))

    def severity(self, attribute: str) -> float:
        """How severe one of its attributes is, from 0 to 1."""
        return dict(self.severities).get(attribute, 1.0)

    @property
    def name(self) -> str:
        """The id without its scenario: "gore+mossy_bricks", "default", "complete", "gore=0.5", "procedural-train"."""
        severities = {self.severity(name) for name in self.attributes}
        if self.maps is None and set(self.attributes) == set(self.scenario.complete) and len(severities) == 1:
            return "complete" + graded_name(*severities)
        drawn = () if self.maps is None else (self.maps.name,)
        return "+".join((*drawn, *(name + graded_name(self.severity(name)) for name in self.attributes))) or "default"

    @property
    def id(self) -> str:
        """Canonical id: "defend_the_center/gore+mossy_bricks"."""
        return f"{self.scenario.id}/{self.name}"

    @property
    def level(self) -> int:
        """Difficulty: the number of groups its attributes change, at most MAX_LEVEL. What is drawn does not count."""
        groups = sum(len(self.scenario.attribute(name).groups) for name in self.attributes)
        return min(groups, MAX_LEVEL)

    def __str__(self) -> str:
        return self.id


def words(text: str) -> tuple[str, ...]:
    """The words of a text, to write a list of names as plain text."""
    return tuple(text.split())
