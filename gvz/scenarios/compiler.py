"""Task -> WAD file: content of a task, its maps, script and classes, and the cache.

The WAD of a task is built each time (some 20 ms) and stored in the user's cache directory under the hash of its bytes.
So a file of another version of the code is never used. If a task has several maps, because they are drawn or because an
attribute is in force in a part of the episodes, this file holds the classes and textures of all of them, and one map;
`CompiledTask.map_of` makes the map of an episode when it is played (a few ms), and keeps it. Nothing here starts an
engine.
"""

import dataclasses
import hashlib
import itertools
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from string import Template

from gvz.core.cache import cache_directory
from gvz.core.env_config import Profile
from gvz.core.errors import ResourceError, TaskError, WadError, nearest
from gvz.scenarios import looks
from gvz.scenarios.base import Attribute, Chance, Content, Task, Thing, Toward, Uniform, Value
from gvz.scenarios.checks import check_kinds
from gvz.scenarios.floor import Floor
from gvz.scenarios.layout import Layout
from gvz.scenarios.map_set import MapSet
from gvz.scenarios.severity import graded, in_force, is_whole
from gvz.wad.acs import compile_acs
from gvz.wad.decorate import declared_actors, declared_numbers, used_sprites
from gvz.wad.lumps import MAP_NAME, read_maps, read_wad, write_map_wad
from gvz.wad.stock import scenario_wad, stock_editor_numbers, stock_patches, stock_sprites, stock_textures
from gvz.wad.textures import blended, check_textures
from gvz.wad.udmf import UdmfMap, is_inside, make_thing, parse_textmap, write_textmap

_NUMBER = re.compile(r"(?<![\w.-])(?:[0-9]+\.[0-9]+|[0-9]{7,})(?![\w.])")
"""a fixed-point number or a large integer in a script"""
_FUZZ = re.compile("fuzzy|spectre|blursphere|type = 58;", re.IGNORECASE)
"""what draws something with the fuzz effect: a render style, Doom's spectre (thing 58), what hides the agent"""
_MARK = 23117
"""what stands for a number while a script is compiled: a fixed-point one near this, or an integer of the same bits"""


@dataclass(frozen=True, kw_only=True, slots=True)
class CompiledTask:
    """A task's WAD file, ready to load."""

    task: Task
    profile: Profile
    wad_path: Path
    map_magic: int
    """the value that the MAP_MAGIC variable of this file's map has"""
    has_fuzz: bool
    """something may be drawn with the fuzz effect"""

    def map_of(self, episode_seed: int) -> tuple[bytes | None, int]:
        """(The WAD of an episode's own map, None for that of `wad_path`; the value of the map's MAP_MAGIC).

        Raises:
            TaskError: the drawn map cannot be played.
        """
        played, maps = _in_force(self.task, self.profile, episode_seed), self.task.maps
        if maps is not None:
            return _map_alone(played, self.profile, maps.number_of(episode_seed))
        return (None, self.map_magic) if played == self.task else _map_alone(played, self.profile)


@dataclass(frozen=True, kw_only=True, slots=True)
class MapSource:
    """All texts in a task's WAD."""

    textmap: str
    script: str
    decorate: str
    textures: str
    map_magic: int


def compile_task(task: Task, profile: Profile = "thesis") -> CompiledTask:
    """Builds a task's WAD and puts it into the cache directory. Safe for many processes at once.

    The directory is $GVZ_CACHE_DIR, or else the user's cache directory.

    Raises:
        TaskError, WadError: see map_source.
        AcsError: the script does not compile.
        ResourceError: the cache directory cannot be written.
    """
    source = map_source(task, profile)
    path = _cached(build_wad(source))
    has_fuzz = _FUZZ.search(f"{source.textmap}\0{source.script}\0{source.decorate}") is not None
    return CompiledTask(task=task, profile=profile, wad_path=path, map_magic=source.map_magic, has_fuzz=has_fuzz)


@lru_cache(maxsize=1000)
def _map_alone(task: Task, profile: Profile, number: int | None = None) -> tuple[bytes, int]:
    """(The WAD of a map alone, its magic number). The classes and textures of all maps are in the task's own file."""
    source = map_source(task, profile, number)
    behavior = _compiled_by_form(source.script, source.decorate)
    return write_map_wad(textmap=source.textmap, behavior=behavior, scripts=source.script), source.map_magic


def _in_force(task: Task, profile: Profile, episode_seed: int) -> Task:
    """The task that an episode plays: a whole attribute of severity below 1 is in force in a part of the episodes."""
    sometimes = _sometimes(task, profile)
    idle = tuple(name for name in sometimes if not in_force(task.severity(name), name, episode_seed))
    return _one_way(task, profile, idle)


def _sometimes(task: Task, profile: Profile) -> list[str]:
    """Its attributes that have a severity below 1 and nothing in between."""
    return [name for name, _ in task.severities if is_whole(_change(task.scenario.attribute(name), profile))]


@lru_cache(maxsize=1000)
def _one_way(task: Task, profile: Profile, idle: tuple[str, ...]) -> Task:
    """The task with these attributes left out, and others that are sometimes in force in force."""
    fixed = dict.fromkeys(_sometimes(task, profile), 1.0) | dict.fromkeys(idle, 0.0)
    if not fixed:
        return task
    scenario = dataclasses.replace(task.scenario, levdoom_tasks={})  # also if what is left has a whole task's name
    return dataclasses.replace(task, scenario=scenario, severities=tuple({**dict(task.severities), **fixed}.items()))


def _all_ways(task: Task, profile: Profile) -> Content:
    """The classes and blended textures of all maps that the task's episodes play."""
    sometimes, found = _sometimes(task, profile), Content()
    for idle in itertools.product((False, True), repeat=len(sometimes)):
        content = task_content(_one_way(task, profile, tuple(itertools.compress(sometimes, idle))), profile)
        found = found.overlaid(Content(actors=content.actors, blends=content.blends))
    return found


def _compiled_by_form(script: str, decorate: str) -> bytes:
    """The same bytes as `compile_acs`, from a compiled script that differs in numbers only, if there was one.

    Most scripts of drawn maps differ in numbers only, and to compile one takes as long as to draw the map. A script is
    compiled itself if it may have numbers that the compiler calculates with or sorts, or that are in a text.
    """
    if re.search("switch|define", script, re.IGNORECASE):
        return _compile(script, decorate)
    values: list[tuple[int, int]] = []  # (that of a mark, that of the number in its place)

    def mark(match: re.Match[str]) -> str:
        whole, point, fraction = match[0].partition(".")
        value = int(whole) if not point else (int(whole) << 16) + (int(fraction) << 16) // 10 ** len(fraction)
        if not 256 <= value < 2**31:  # the compiler has shorter code for small ones, and refuses large ones
            return match[0]
        place = len(values) + 1
        values.append(((_MARK << 16) + place, value))
        return str((_MARK << 16) + place) if not point else f"{_MARK}.{(2 * place + 1) * 10**8 >> 17:08}"

    form = _compile_form(_NUMBER.sub(mark, script), decorate)
    compiled = bytearray(form)
    for marked, value in values:
        bits = marked.to_bytes(4, "little")
        if form.count(bits) != 1:  # the compiler calculated with it, or it is in a text or a comment
            return _compile(script, decorate)
        place = form.index(bits)
        compiled[place : place + 4] = value.to_bytes(4, "little")
    return bytes(compiled)


def _compile(script: str, decorate: str) -> bytes:
    return compile_acs(script, actor_classes=declared_actors(decorate))


_compile_form = lru_cache(maxsize=1000)(_compile)


def task_content(task: Task, profile: Profile) -> Content:
    """The contents of a task's map: the scenario's content, changed by each attribute in the scenario's order.

    In profile levdoom, each step is overlaid by its `levdoom`, and the result by the task's own exception.
    """
    scenario, levdoom = task.scenario, profile == "levdoom"
    content = scenario.content.overlaid(scenario.levdoom) if levdoom else scenario.content
    for attribute in scenario.attributes:
        if attribute.name in task.attributes:
            change, severity = _change(attribute, profile), task.severity(attribute.name)
            if severity < 1 and not is_whole(change):
                change = graded(content, change, severity)
            content = content.joined(change)
    exception = scenario.levdoom_tasks.get(task.name) if levdoom else None
    return content if exception is None else content.overlaid(exception)


def _change(attribute: Attribute, profile: Profile) -> Content:
    """What an attribute changes in a profile."""
    return attribute.content.overlaid(attribute.levdoom) if profile == "levdoom" else attribute.content


def map_source(task: Task, profile: Profile, number: int | None = None) -> MapSource:
    """The texts of a task's WAD, or of a drawn map, by default the first; the magic number is made of their hash.

    Raises:
        TaskError: a drawn map cannot be played; the parameters of scenario and attributes do not match the script's
            names; a thing is not on a map of the scenario, is outside the map, or has an unknown class; a sprite does
            not exist.
        WadError: an unknown texture or base map.
    """
    content = task_content(task, profile)
    if task.maps is None:
        drawn = _draw(task, content)
    else:
        content, drawn = _draw_of_set(task, task.maps, content, task.maps.number_of(0) if number is None else number)
    every = _all_ways(task, profile).overlaid(content)
    decorate = "\n".join(every.actors.values())
    _check_sprites(task, decorate)
    drawn.things += [
        make_thing(t.type, t.x, t.y, tid=t.tid) for t in _checked_things(task, profile, content, drawn, decorate)
    ]
    try:
        check_textures(drawn, {*stock_textures(), *content.blends})
        textures = "".join(
            blended(name, blend.under, blend.over, blend.opacity, stock_textures(), stock_patches())
            for name, blend in every.blends.items()
        )
    except WadError as error:
        raise WadError(f"task {task.id}: {error}") from error
    textmap = write_textmap(drawn)
    template = Template(task.scenario.script)
    if not template.is_valid():
        raise TaskError(f"task {task.id}: the script has a '$' that begins no name; write '$$' for a '$' of its own")
    check_kinds(task, content)
    names = _script_names(content)
    if (given := {*names, "map_magic"}) != (used := set(template.get_identifiers())):
        raise TaskError(
            f"task {task.id}: the script uses {sorted(used - given)}, which nothing sets; "
            f"set but not used: {sorted(given - used)}; want `content.parameters` to fit the script's $names"
        )
    everything = "\0".join((textmap, decorate, template.substitute(names, map_magic=0)))
    digest = hashlib.sha256(everything.encode()).digest()
    magic = int.from_bytes(digest[:4], "little") % (2**31 - 1) + 1
    script = template.substitute(names, map_magic=magic)
    return MapSource(textmap=textmap, script=script, decorate=decorate, textures=textures, map_magic=magic)


def build_wad(source: MapSource) -> bytes:
    """The bytes of a WAD file with one map; the same source gives the same bytes.

    Raises:
        AcsError: the script does not compile.
    """
    behavior = _compile(source.script, source.decorate)
    return write_map_wad(
        textmap=source.textmap,
        behavior=behavior,
        scripts=source.script,
        decorate=source.decorate,
        textures=source.textures,
    )


def acs_value(value: Value) -> str:
    """A value as ACS source text."""
    match value:
        case Uniform(low, high):
            return f"Random({acs_value(low)}, {acs_value(high)})"
        case float():
            text = f"{value:.6f}".rstrip("0")
            return f"{text}0" if text.endswith(".") else text
        case tuple():
            return "{" + ", ".join(f'"{v}"' if isinstance(v, str) else acs_value(v) for v in value) + "}"
        case _:
            return str(value)


def _script_names(content: Content) -> dict[str, str]:
    """All names of a script template and their values, except the magic number."""
    names = {name: acs_value(value) for name, value in content.parameters.items()}
    sizes = {f"num_{n}": str(len(v)) for n, v in content.parameters.items() if isinstance(v, tuple)}
    return {
        **names,
        **sizes,
        "entity_properties": _set_properties("tid", content.entity),
        "agent_properties": _set_properties("0", content.agent),
    }


def _set_properties(tid: str, properties: Mapping[str, Value]) -> str:
    lines: list[str] = []
    for name, value in properties.items():
        now, condition = f"GetActorProperty({tid}, APROP_{name})", ""
        match value:
            case Toward(end, share):
                text = f"{now} + FixedMul({acs_value(share)}, {acs_value(end)} - {now})"
            case Chance(whole, share, otherwise):
                if otherwise is not None:
                    lines.append(f"SetActorProperty({tid}, APROP_{name}, {otherwise});")
                text, condition = whole, f"if (Random(0.0, 1.0) < {acs_value(share)}) "
            case _:
                text = acs_value(value)
        lines.append(f"{condition}SetActorProperty({tid}, APROP_{name}, {text});")
    return " ".join(lines)


def _draw(task: Task, content: Content, layout: Layout | None = None) -> UdmfMap:
    """The base map with the content's textures and the scenario's own changes, or with another layout."""
    assert content.base_wad is not None
    assert content.textures is not None
    drawn = _base_map(content.base_wad).copy()
    if task.scenario.draw_map is not None:
        task.scenario.draw_map(drawn)
    if layout is not None:
        drawn = layout.build(drawn)
    for side in drawn.sidedefs:
        if "texturemiddle" in side:  # sides between two open spaces have none
            side["texturemiddle"] = content.textures.wall
    for sector in drawn.sectors:
        sector["texturefloor"] = content.textures.floor
        sector["textureceiling"] = content.textures.ceiling
    return drawn


def _draw_of_set(task: Task, maps: MapSet, content: Content, number: int) -> tuple[Content, UdmfMap]:
    """(What a map of a set has instead of the task's content, the map); the layout is checked."""
    scenario, layout = task.scenario, None
    assert scenario.variety is not None, "checked where the task was made"
    if strength := maps.strength("layout"):
        layout = scenario.variety.draw_layout(looks.drawn_from(scenario, maps, number, "layout"), strength)
        content = content.overlaid(Content(things={content.base_wad or "": ()}, parameters=layout.parameters))
    drawn = _draw(task, content, layout)
    floor = None if layout is None else Floor(drawn)
    attributes = map(scenario.attribute, task.attributes)
    given = {name for attribute in attributes for name in (*attribute.content.entity, *attribute.not_drawn)}
    content = looks.draw_look(scenario, content, drawn, maps, number, given, layout, floor)
    if layout is not None and floor is not None:
        solids = looks.solid_places(drawn)
        problem = layout.problem(Floor(drawn, solids) if solids else floor)
        if problem is not None:
            raise TaskError(f"{task.id}, map {number}: {problem}; this is a mistake of the scenario's draw_layout")
    return content, drawn


@cache
def _base_map(file_name: str) -> UdmfMap:
    """The map of one of the engine's scenarios. To be copied, never changed."""
    return parse_textmap(read_maps(read_wad(scenario_wad(file_name)))[MAP_NAME]["TEXTMAP"].decode("latin-1"))


def _checked_things(task: Task, profile: Profile, content: Content, drawn: UdmfMap, decorate: str) -> tuple[Thing, ...]:
    """The things added to the base map. The engine itself would leave out an invalid thing, or show a sign instead."""
    scenario = task.scenario
    parts = [scenario.content, scenario.levdoom, *scenario.levdoom_tasks.values()]
    parts += [part for attribute in scenario.attributes for part in (attribute.content, attribute.levdoom)]
    base_maps = sorted({part.base_wad for part in parts if part.base_wad is not None})
    if strange := sorted(content.things.keys() - set(base_maps)):
        raise TaskError(
            f"task {task.id}: got things on {', '.join(strange)}{nearest(strange[0], base_maps)}, "
            f"want a base map of the scenario: {', '.join(base_maps)}"
        )
    assert content.base_wad is not None
    for attribute in map(scenario.attribute, task.attributes):
        if (own := _change(attribute, profile).things) and content.base_wad not in own:
            raise TaskError(
                f"task {task.id}: {attribute.name} has things on {', '.join(own)} alone, want places on "
                f"{content.base_wad}, too, or () for none there"
            )
    things = content.things.get(content.base_wad, ())
    numbers = stock_editor_numbers() | declared_numbers(decorate)
    for thing in things:
        if thing.type not in numbers:
            raise TaskError(f"task {task.id}: got {thing}, want the editor number of an actor class of Doom's")
        if not is_inside(drawn, thing.x, thing.y):
            raise TaskError(f"task {task.id}: got {thing}, want a place inside the map {content.base_wad}")
    return things


def _check_sprites(task: Task, decorate: str) -> None:
    """Refuses classes with missing sprites; the engine itself would show nothing and go on."""
    if strange := sorted(used_sprites(decorate) - stock_sprites()):
        raise TaskError(
            f"task {task.id}: its DECORATE shows the unknown sprite {strange[0][:4]}, frame {strange[0][4]}"
            f"{nearest(strange[0], sorted(stock_sprites()))}; want sprites of freedoom2.wad"
        )


def _cached(data: bytes) -> Path:
    """The file in the cache directory that holds `data`; writes it if it is missing or damaged."""
    path = cache_directory() / f"{hashlib.sha256(data).hexdigest()}.wad"
    try:
        if path.exists() and path.read_bytes() == data:
            return path
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f"{secrets.token_hex(16)}.tmp")  # not of `tempfile`: only its owner could read it
        try:
            temporary.write_bytes(data)
            temporary.replace(path)  # readers see the old file or the complete new one
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise ResourceError(
            f"map cache {cache_directory()}: {error}; make it writable, or set GVZ_CACHE_DIR to a directory that is"
        ) from error
    return path
