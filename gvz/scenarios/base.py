"""What a scenario, an attribute and a task are.

A scenario is data: a base map, a script template and what they hold by default (`Content`). An attribute is the
`Content` it changes. A task is a scenario with a set of attributes. `gvz.scenarios.compiler` makes a map of it.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from types import MappingProxyType
from typing import Literal

from gvz.core.env_config import EnvConfig, Profile
from gvz.core.errors import TaskError
from gvz.scenarios.rewards import Reward, Rewarder, check_weights, return_range
from gvz.wad.udmf import UdmfMap


@dataclass(frozen=True, slots=True)
class Uniform:
    """A number drawn uniformly, ends included, whenever the script comes to it."""

    low: float
    high: float


Value = int | float | str | Uniform | tuple[str | float, ...]
"""A value in a script. int: ACS integer; float: fixed point; str: verbatim ACS expression; tuple: initializer of an
array, whose strings are quoted."""

BOOKKEEPING: Mapping[str, str] = MappingProxyType(
    {
        "PLAYER_KILLS": "USER1",  # enemies killed by the agent itself; KILLCOUNT also counts infighting
        "SPAWNED": "USER2",  # enemies or kits put on the map so far
        "KITS_TAKEN": "USER3",
        "POISONS_TAKEN": "USER4",
        "MAP_MAGIC": "USER60",  # `CompiledTask.map_magic`: proves that the right map runs
    }
)
"""Variables every compiled map keeps beside the engine's own -> ViZDoom game variable. Those a scenario has no use
for stay 0. USERn is the script's `global int n`."""

Split = Literal["train1", "train4", "train8", "test"]

MAX_LEVEL = 4
"""Tasks of four and more attributes are level 4 (thesis 3.2: beyond three, difficulty hardly grows)."""


@dataclass(frozen=True, slots=True)
class Textures:
    """One texture name for all walls, all floors, all ceilings; walls may name flats and the other way round."""

    wall: str
    floor: str
    ceiling: str


@dataclass(frozen=True, slots=True)
class Thing:
    """Something that stands on the map from the start. Position in map units, `type` is an editor number."""

    type: int
    x: float
    y: float
    tid: int = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class Content:
    """What a map holds, or what a profile or an attribute changes of it."""

    base_wad: str | None = None
    """file name in vizdoom's scenarios directory"""
    textures: Textures | None = None
    things: Mapping[str, tuple[Thing, ...]] = field(default_factory=dict)
    """things added, by base map (a coordinate means something on one map only)"""
    parameters: Mapping[str, Value] = field(default_factory=dict)
    """values of the `$names` of the scenario's script; an array `x` also defines its length, `num_x`"""
    entity: Mapping[str, Value] = field(default_factory=dict)
    """APROP name -> value, set on every enemy or kit when it spawns"""
    agent: Mapping[str, Value] = field(default_factory=dict)
    """APROP name -> value, set on the agent when it enters"""
    actors: Mapping[str, str] = field(default_factory=dict)
    """class name -> its DECORATE definition"""

    def overlaid(self, other: "Content") -> "Content":
        """This content, with everything `other` states in place of its own."""
        return Content(
            base_wad=self.base_wad if other.base_wad is None else other.base_wad,
            textures=self.textures if other.textures is None else other.textures,
            things={**self.things, **other.things},
            parameters={**self.parameters, **other.parameters},
            entity={**self.entity, **other.entity},
            agent={**self.agent, **other.agent},
            actors={**self.actors, **other.actors},
        )

    def joined(self, other: "Content") -> "Content":
        """`overlaid`, but the things of both stand on the map."""
        things = {
            base_wad: self.things.get(base_wad, ()) + other.things.get(base_wad, ())
            for base_wad in (*self.things, *(other.things.keys() - self.things.keys()))
        }
        return self.overlaid(dataclasses.replace(other, things=things))


@dataclass(frozen=True, kw_only=True, slots=True)
class Attribute:
    """One visual modification of a scenario."""

    name: str
    groups: tuple[str, ...]
    """a task has at most one attribute of a group; each group counts one level"""
    content: Content
    levdoom: Content = field(default_factory=Content)
    """what profile levdoom has in place of parts of `content`"""
    aliases: tuple[str, ...] = ()
    """the thesis's shorter names in combined tasks ("fast+flying")"""


@dataclass(frozen=True, kw_only=True, repr=False)
class Scenario:
    """A map, an objective, a reward and buttons; the first extension point of the benchmark.

    Scenarios can be pickled, and are equal if all that they hold is, whichever process made them.
    """

    id: str
    title: str
    content: Content
    """what the default task's map holds"""
    levdoom: Content
    """what profile levdoom has in place of parts of it"""
    script: str
    """ACS source with `$names` (string.Template): `content.parameters`, and `$entity_properties`,
    `$agent_properties`, `$map_magic`, which the compiler fills in"""
    attributes: tuple[Attribute, ...]
    """where two set the same value, the later one wins"""
    complete: tuple[str, ...]
    """attributes of the task `complete`: one of every group"""
    levdoom_tasks: Mapping[str, Content] = field(default_factory=dict)
    """exceptions of profile levdoom: task ("default", "gore+mossy_bricks", ...) -> what its map has instead"""
    tasks: tuple[str, ...]
    """the named tasks, in the thesis's order"""
    splits: Mapping[Split, tuple[str, ...]]
    """training sets of 1, 4 and 8 tasks, and the test set"""
    draw_map: Callable[[UdmfMap], None] | None = None
    """changes the base map in place, before textures and things"""

    buttons: tuple[str, ...]
    combination_buttons: tuple[str, ...] | None = None
    """the buttons that action set `combinations` combines; default all of them"""
    game_variables: tuple[str, ...]
    """what the agent may see beside pixels"""
    metric: Literal["frames_alive", "kills"]
    render_weapon: bool
    timeouts: Mapping[Profile, int]
    upper_bounds: Mapping[Profile, float]
    """best possible score"""
    rewards: Mapping[str, Reward]

    def __hash__(self) -> int:
        return hash(self.id)  # the other fields hold mappings

    def __repr__(self) -> str:
        return f"Scenario({self.id!r})"

    @property
    def base_wad(self) -> str:
        """File name, in vizdoom's scenarios directory, of the map the default task is made from."""
        assert self.content.base_wad is not None
        return self.content.base_wad

    def timeout_frames(self, profile: Profile = "thesis") -> int:
        """Game tics after which an episode is truncated."""
        return self.timeouts[profile]

    def upper_bound(self, profile: Profile = "thesis") -> float:
        """Best possible score, to normalize by."""
        return self.upper_bounds[profile]

    def reward_weights(
        self, weights: Mapping[str, float] | None = None, profile: Profile = "thesis"
    ) -> dict[str, float]:
        """The weight of every reward component.

        Args:
            weights: component -> weight, in place of the profile's; those not named keep theirs.
            profile: whose weights.

        Raises:
            ConfigError: a weight whose name is no component's, or that is no finite number.
        """
        defaults = {n: r.levdoom if profile == "levdoom" else r.weight for n, r in self.rewards.items()}
        return defaults if weights is None else {**defaults, **check_weights(weights, defaults)}

    def make_rewarder(self, weights: Mapping[str, float] | None = None, profile: Profile = "thesis") -> Rewarder:
        """A rewarder for one game, with `reward_weights(weights, profile)`; raises as that does."""
        return Rewarder({n: r.event for n, r in self.rewards.items()}, self.reward_weights(weights, profile))

    def return_range(self, env: EnvConfig, discount: float) -> tuple[float, float]:
        """(v_min, v_max): the range of discounted returns in this scenario's tasks.

        Args:
            env: its profile, frame skip and reward weights.
            discount: of one decision.

        Raises:
            ConfigError: a weight whose name is no component's.
        """
        weights = self.reward_weights(dict(env.reward_weights), env.profile)
        return return_range(self.rewards, weights, env, discount)

    def attribute(self, name: str) -> Attribute:
        """The attribute called `name`, or by that alias.

        Raises:
            TaskError: there is none; lists those there are, and the nearest.
        """
        for attribute in self.attributes:
            if name == attribute.name or name in attribute.aliases:
                return attribute
        raise TaskError(
            f"scenario {self.id}: unknown attribute {name!r}{nearest(name, [a.name for a in self.attributes])}; "
            f"want {self.choices()}"
        )

    def choices(self) -> str:
        """Its attributes by group, for error messages."""
        groups: dict[str, list[str]] = {}
        for attribute in self.attributes:
            for group in attribute.groups:
                groups.setdefault(group, []).append(attribute.name)
        members = "; ".join(f"{group}: {', '.join(names)}" for group, names in groups.items())
        return f"default, complete, or at most one of each group ({members})"


@dataclass(frozen=True, slots=True)
class Task:
    """A scenario with a set of attributes. `gvz.tasks.parse_task` makes it from an id.

    Attributes:
        scenario: the scenario.
        attributes: canonical names, sorted.

    Raises:
        TaskError: an unknown attribute, or two of one group.
    """

    scenario: Scenario
    attributes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        found = [self.scenario.attribute(name) for name in self.attributes]
        taken: dict[str, str] = {}
        for attribute in found:
            for group in attribute.groups:
                if group in taken:
                    raise TaskError(
                        f"scenario {self.scenario.id}: {taken[group]} and {attribute.name} are both of group "
                        f"{group}; want {self.scenario.choices()}"
                    )
                taken[group] = attribute.name
        object.__setattr__(self, "attributes", tuple(sorted(attribute.name for attribute in found)))

    @property
    def name(self) -> str:
        """The id without its scenario: "gore+mossy_bricks", "default", "complete"."""
        if set(self.attributes) == set(self.scenario.complete):
            return "complete"
        return "+".join(self.attributes) or "default"

    @property
    def id(self) -> str:
        """Canonical id: "defend_the_center/gore+mossy_bricks"."""
        return f"{self.scenario.id}/{self.name}"

    @property
    def level(self) -> int:
        """Difficulty: the number of groups its attributes change, at most MAX_LEVEL."""
        groups = sum(len(self.scenario.attribute(name).groups) for name in self.attributes)
        return min(groups, MAX_LEVEL)

    def __str__(self) -> str:
        return self.id


def words(text: str) -> tuple[str, ...]:
    """The words of a text: a list of names as it is read aloud."""
    return tuple(text.split())


def nearest(name: str, known: Sequence[str]) -> str:
    """A hint at the known name most like `name`, or nothing."""
    match = get_close_matches(name, known, n=1)
    return f" (did you mean {match[0]!r}?)" if match else ""
