"""A scene as a text file that a person reads and changes, and the scenes that cairn ships.

It is TOML, in metres, degrees and degrees Celsius. A fact stands once: a material under its name, a thing of several
solids as an object that is placed as often as needed.

    format = "cairn-scene"
    version = 1
    name = "office"
    ambient_c = 21.0                      # what bare metal mirrors; materials have it too, where they say nothing
    sky_c = -10.0                         # ambient_c when left out
    sky = "#aac8e8"                       # colour where nothing is met

    [materials]
    tile = {colour = "#968c7d", emissivity = 0.95, nir = 0.45, gloss = 0.1}
    grout = {colour = "#69645f", temperature_c = 18.0}
    pane = {colour = "#d0e0e0", emissivity = 0.9, optics = "glass"}    # or "mirror"

    [surfaces]                            # two materials that take turns; inf makes stripes; grain is a pattern
    tiles = {material = "tile", second = "grout", period_m = [0.5, inf], phase_m = [0, 0], grain = 0.1, grain_m = 0.05}

    [objects.stool]                       # solids, relative to the object's foot
    parts = [
      {name = "seat", box = [0.4, 0.4, 0.04], at = [0, 0, 0.46], surface = "tile"},
      {name = "leg", cylinder = [0.03, 0.46], surface = "grout"},
    ]

    [areas.hall]                          # groups for the reader only
    solids = [{name = "floor", from = [0, 0, -0.2], to = [6, 5, 0], surface = "tiles"}]
    places = [{object = "stool", name = "stool", at = [1, 2, 0], turn_deg = 30, surfaces = {tile = "grout"}}]

A solid has one of these shapes, and a `surface` that names a surface or a material:

    from, to = [x, y, z]                  box between its lowest and its highest corner
    box = [x, y, z]                       `at` is the middle of its lower face
    cylinder = [radius, height]           `at` is the middle of its lower face
    sphere = radius                       `at` is its centre
    plane = true                          all below a plane; `at` is on it, and its own +z is outside

`turn_deg` is an angle about z, or [x, y, z]: turned about x, then y, then z, all about `at`. A solid's `temperature_c`
is put in the place of its materials'. `count` and `step_m` place an object again and again: "stool 1", "stool 2".
A part of the object placed as "stool" is named "stool/leg". `surfaces` of a place puts other surfaces for the
object's. No two solids share a name.

What moves is an object with poses at some times, in seconds after the scene's start:

    [objects.leaf]                        # its foot is the hinge
    parts = [{name = "wood", box = [1, 0.04, 2], at = [0.5, 0, 0], surface = "tile"}]

    [[moving]]                            # a door that opens after an hour
    name = "door"
    object = "leaf"
    at = [2, 5, 0]
    keyframes = [{time_s = 3600, turn_deg = 0}, {time_s = 3602, turn_deg = 85}]

    [[moving]]                            # a stool that is brought after ten minutes, and taken away after an hour
    name = "second stool"
    object = "stool"
    keyframes = [{time_s = 0, gone = true}, {time_s = 600, at = [3, 1, 0]}, {time_s = 3600, gone = true}]

    [[moving]]                            # a cart that goes to and fro
    name = "cart"
    object = "stool"
    surfaces = {tile = "grout"}
    keyframes = [{time_s = 0, at = [1, 4, 0]}, {time_s = 5, at = [5, 4, 0]}, {time_s = 10, at = [1, 4, 0]}]
    repeat_s = 10

Between two keyframes its place runs straight and its turn along the shortest arc, less than 180 degrees; before the
first and after the last it stays. A keyframe has `at` and `turn_deg`, zero when left out, or `gone = true`: from then
on it is not there. They count from the `at` and `turn_deg` of the entry, which are the map's when left out.
`repeat_s` seconds after the start all begins again with time 0. A camera's images are of the one time of their scan.

    base = "building"                     # a shipped scene that this one adds to
    without = ["lab 1 door"]              # solids, places and moving objects of it, by the names in its file

A scene with a base has all that the base has, and names of its own for what it adds.
"""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from cairn_calib.rig.poses import Transform
from cairn_map.errors import COMPLAINTS_MAX, BadInputError, complaint_text
from cairn_sim.scene.movements import Keyframe, Movement, MovingObject
from cairn_sim.scene.scene import SOLIDS_MAX, Scene, scene_of
from cairn_sim.scene.scene_format import (
    ORIGIN,
    ZERO_C_K,
    MovingEntry,
    PlaceEntry,
    SceneFile,
    SolidEntry,
    SurfaceEntry,
    Turn,
)
from cairn_sim.scene.solids import Angles3, Box, Cylinder, Plane, Shape, Solid, Sphere, placed
from cairn_sim.scene.surfaces import Material, Optics, Rgb, Surface

SHIPPED = ("building", "small-room", "yard", "moving-building", "moving-yard", "bridge-yard")
"""Names of the scenes that come with cairn."""
FILE_BYTES_MAX = 1 << 20
DOTS_MAX = 64
"""In a line; a key of n dots takes `tomllib` n^2 memory, 160 GB for one of 200 000."""
CAME_MAX = 80
"""Characters of what came, in an error."""
OF_BASE = ("materials", "surfaces", "objects", "areas")
"""Tables that a scene has from its base, and adds to."""
LIGHT = ("ambient_c", "sky_c", "sky")
"""Fields that it has from its base unless it says otherwise."""


def load_scene(name_or_path: str | Path) -> Scene:
    """A shipped scene, by one of the names in `SHIPPED`, or the scene in a file: a `Path`, or text with a / or .toml.

    Raises:
        BadInputError: no shipped scene of that name, no such file, or not a scene.
    """
    if isinstance(name_or_path, str) and "/" not in name_or_path and not name_or_path.endswith(".toml"):
        return scene_from_toml(shipped_text(name_or_path), source=name_or_path)
    path = Path(name_or_path)
    try:
        with path.open("rb") as file:
            data = file.read(FILE_BYTES_MAX + 1)
        text = data.decode()
    except OSError as exc:
        raise BadInputError("missing_file", f"cannot read {path}: {exc.strerror}") from exc
    except UnicodeDecodeError as exc:
        raise _bad(path.name, f"expected UTF-8 text, got {exc.reason} at byte {exc.start}") from exc
    return scene_from_toml(text, source=path.name)


def shipped_text(name: str) -> str:
    """The TOML of a scene that comes with cairn.

    Raises:
        BadInputError: there is none of that name.
    """
    if name not in SHIPPED:
        raise BadInputError("unknown_scene", f"scene must be one of {', '.join(SHIPPED)}, or a file, got {name!r}")
    return (files("cairn_sim") / "scenes" / f"{name}.toml").read_text(encoding="utf-8")


def scene_from_toml(text: str, *, source: str = "scene") -> Scene:
    """The scene that a text describes; `source` is what errors call it.

    Raises:
        BadInputError: not TOML, too large, or not a scene; says which field, what it should be and what it is.
    """
    written = _written(text, source)
    expansion = _Expansion(written, source)
    still = tuple(expansion.solids())
    return scene_of(
        still,
        moving=expansion.moving(),
        name=written.name,
        ambient_k=written.ambient_c + ZERO_C_K,
        sky_k=(written.ambient_c if written.sky_c is None else written.sky_c) + ZERO_C_K,
        sky_srgb=_rgb(written.sky),
    )


def _written(text: str, source: str) -> SceneFile:
    """The entries of a text, and those of its base."""
    if len(text) > FILE_BYTES_MAX:
        raise _bad(source, f"expected at most {FILE_BYTES_MAX} characters, got {len(text)}")
    if max(line.count(".") for line in text.split("\n")) > DOTS_MAX:
        raise _bad(source, f"expected at most {DOTS_MAX} dots in a line, got more")
    try:
        written = SceneFile.model_validate(tomllib.loads(text))
    except ValidationError as exc:
        raise _bad(source, _complaint(exc)) from exc
    except (ValueError, RecursionError) as exc:  # ValueError: TOMLDecodeError, and numbers of too many digits.
        raise _bad(source, f"expected TOML: {exc}") from exc
    if written.base is None:
        if written.without:
            raise _bad(source, "without: expected a base from which to leave things out, got none")
        return written
    if written.base not in SHIPPED:
        raise _bad(source, f"base: expected one of {', '.join(SHIPPED)}, got {written.base!r}")
    return _on_base(written, _written(shipped_text(written.base), written.base), source)


def _on_base(own: SceneFile, base: SceneFile, source: str) -> SceneFile:
    """A scene's entries and those of its base, which come first."""
    fields: dict[str, object] = {"name": own.name, "note": own.note}
    fields |= {light: getattr(own, light) for light in LIGHT if light in own.model_fields_set}
    kept = _left(base, own.without, source)
    for title in OF_BASE:
        added, given = getattr(own, title), getattr(kept, title)
        for name in added:
            if name in given:
                raise _bad(source, f"{title}.{name}: expected a name that {base.name} does not have, got {name!r}")
        fields[title] = given | added
    return kept.model_copy(update=fields | {"moving": (*kept.moving, *own.moving)})


def _left(base: SceneFile, without: tuple[str, ...], source: str) -> SceneFile:
    """A scene's entries but for some solids, places and moving objects."""
    known = {each.name for each in base.moving}
    areas = {}
    for title, area in base.areas.items():
        known |= {solid.name for solid in area.solids} | {place.name for place in area.places}
        solids = tuple(solid for solid in area.solids if solid.name not in without)
        places = tuple(place for place in area.places if place.name not in without)
        areas[title] = area.model_copy(update={"solids": solids, "places": places})
    for number, name in enumerate(without):
        if name not in known:
            raise _bad(source, f"without.{number}: expected a name that stands in {base.name}, got {name!r}")
    moving = tuple(each for each in base.moving if each.name not in without)
    return base.model_copy(update={"areas": areas, "moving": moving})


class _Expansion:
    """A scene file turned into solids: names looked up, objects placed."""

    def __init__(self, written: SceneFile, source: str) -> None:
        self.written = written
        self.source = source
        self.surfaces = self._surfaces()
        self.names: set[str] = set()

    def solids(self) -> Iterator[Solid]:
        """All of them, area by area, what stands by itself first.

        Raises:
            BadInputError: a name that is not there or twice there, or too many solids.
        """
        self._check_count()
        for title, area in self.written.areas.items():
            for n, entry in enumerate(area.solids):
                yield self._solid(entry, f"areas.{title}.solids.{n}", entry.name, np.eye(4), {})
            for n, place in enumerate(area.places):
                yield from self._placed(place, f"areas.{title}.places.{n}")

    def moving(self) -> list[MovingObject]:
        """All objects that move; to be asked after `solids`, whose names they may not have.

        Raises:
            BadInputError: a name that is not there or twice there, or a movement that is none.
        """
        found = []
        for n, entry in enumerate(self.written.moving):
            where = f"moving.{n}"
            solids = tuple(self._parts(entry, where, entry.name, np.eye(4)))
            try:
                found.append(MovingObject(entry.name, solids, _movement(entry)))
            except BadInputError as exc:
                raise _bad(self.source, f"{where}: {exc.message}") from exc
        return found

    def _check_count(self) -> None:
        count = 0
        for title, area in self.written.areas.items():
            count += len(area.solids)
            for n, place in enumerate(area.places):
                self._check_known(f"areas.{title}.places.{n}.object", place.object, self.written.objects)
                count += place.count * len(self.written.objects[place.object].parts)
        for n, entry in enumerate(self.written.moving):
            self._check_known(f"moving.{n}.object", entry.object, self.written.objects)
            count += len(self.written.objects[entry.object].parts)
        if not 1 <= count <= SOLIDS_MAX:
            raise _bad(self.source, f"areas: expected 1 to {SOLIDS_MAX} solids in all, got {count}")

    def _placed(self, place: PlaceEntry, where: str) -> Iterator[Solid]:
        turn_rad = _turn_rad(place.turn_deg)
        for n in range(place.count):
            x, y, z = (a + n * step for a, step in zip(place.at, place.step_m, strict=True))
            name = place.name if place.count == 1 else f"{place.name} {n + 1}"
            yield from self._parts(place, where, name, placed((x, y, z), turn_rad))

    def _parts(self, entry: PlaceEntry | MovingEntry, where: str, name: str, T: Transform) -> Iterator[Solid]:
        """The solids of an entry's object, at a pose."""
        parts = self.written.objects[entry.object].parts
        own = {part.surface: part for part in parts}
        for old, new in entry.surfaces.items():
            self._check_known(f"{where}.surfaces", old, own)
            self._check_known(f"{where}.surfaces.{old}", new, self.surfaces)
        for k, part in enumerate(parts):
            yield self._solid(part, f"objects.{entry.object}.parts.{k}", f"{name}/{part.name}", T, entry.surfaces)

    def _solid(self, entry: SolidEntry, where: str, name: str, T: Transform, other: Mapping[str, str]) -> Solid:
        if name in self.names:
            raise _bad(self.source, f"{where}.name: expected a name of its own, got {name!r} again")
        self.names.add(name)
        called = other.get(entry.surface, entry.surface)
        self._check_known(f"{where}.surface", called, self.surfaces)
        surface = self.surfaces[called]
        if entry.temperature_c is not None:
            surface = _at_temperature(surface, entry.temperature_c + ZERO_C_K)
        shape, T_own = _shape(entry)
        return Solid(name, shape, surface, T @ T_own)

    def _surfaces(self) -> dict[str, Surface]:
        """Each surface and, as a plain surface, each material, by its name."""
        materials = self._materials()
        found = {name: Surface(material) for name, material in materials.items()}
        for name, entry in self.written.surfaces.items():
            where = f"surfaces.{name}"
            if name in materials:
                raise _bad(self.source, f"{where}: expected a name that no material has, got {name!r}")
            found[name] = self._surface(entry, where, materials)
        return found

    def _surface(self, entry: SurfaceEntry, where: str, materials: Mapping[str, Material]) -> Surface:
        self._check_known(f"{where}.material", entry.material, materials)
        if entry.second is not None:
            self._check_known(f"{where}.second", entry.second, materials)
        try:
            return Surface(
                materials[entry.material],
                None if entry.second is None else materials[entry.second],
                period_m=entry.period_m,
                phase_m=entry.phase_m,
                grain=entry.grain,
                grain_m=entry.grain_m,
            )
        except BadInputError as exc:
            raise _bad(self.source, f"{where}: {exc.message}") from exc

    def _materials(self) -> dict[str, Material]:
        return {
            name: Material(
                colour_srgb=_rgb(m.colour),
                temperature_k=(self.written.ambient_c if m.temperature_c is None else m.temperature_c) + ZERO_C_K,
                emissivity=m.emissivity,
                reflectivity_nir=m.nir,
                gloss_nir=m.gloss,
                retroreflection=m.retroreflection,
                optics=Optics[m.optics.upper()],
            )
            for name, m in self.written.materials.items()
        }

    def _check_known(self, where: str, name: str, known: Mapping[str, object]) -> None:
        if name not in known:
            listed = ", ".join(sorted(known))
            raise _bad(self.source, f"{where}: expected one of {listed[:400]}, got {name!r}")


def _shape(entry: SolidEntry) -> tuple[Shape, Transform]:
    """The shape of an entry, and where its own frame is."""
    if entry.from_ is not None and entry.to is not None:
        low, high = np.array(entry.from_), np.array(entry.to)
        x, y, z = (high - low).tolist()
        T = np.eye(4)
        T[:3, 3] = (low + high) / 2
        return Box((x, y, z)), T
    T = placed(entry.at or ORIGIN, _turn_rad(entry.turn_deg or ORIGIN))
    if entry.box is not None:
        return Box(entry.box), T @ placed((0.0, 0.0, entry.box[2] / 2))
    if entry.cylinder is not None:
        radius_m, height_m = entry.cylinder
        return Cylinder(radius_m, height_m), T @ placed((0.0, 0.0, height_m / 2))
    return (Plane() if entry.sphere is None else Sphere(entry.sphere)), T


def _movement(entry: MovingEntry) -> Movement:
    """The movement of an entry."""
    keyframes = [
        Keyframe(each.time_s, None if each.gone else placed(each.at, _turn_rad(each.turn_deg)))
        for each in entry.keyframes
    ]
    return Movement(tuple(keyframes), placed(entry.at, _turn_rad(entry.turn_deg)), entry.repeat_s)


def _turn_rad(turn_deg: Turn) -> Angles3:
    x, y, z = turn_deg
    return float(np.radians(x)), float(np.radians(y)), float(np.radians(z))


def _at_temperature(surface: Surface, kelvin: float) -> Surface:
    """The same surface, both materials at one temperature."""
    second = None if surface.second is None else replace(surface.second, temperature_k=kelvin)
    return replace(surface, material=replace(surface.material, temperature_k=kelvin), second=second)


def _rgb(colour: str) -> Rgb:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def _complaint(exc: ValidationError) -> str:
    """Message on the first wrong field: its place, the values expected there, and the value that came."""
    if exc.error_count() > COMPLAINTS_MAX:
        return f"more than {COMPLAINTS_MAX} fields are wrong"
    first = exc.errors(include_url=False, include_context=False)[0]
    where = ".".join(str(part) for part in first["loc"]) or "document"
    what = complaint_text(first["msg"])
    came = first["input"]
    # A table's or a list's text may be as long as the file, and as deep.
    said = repr(came)[:CAME_MAX] if isinstance(came, str | bool | int | float) else f"a {type(came).__name__}"
    return f"{where[:200]}: {what[:200]}" + ("" if isinstance(came, dict) else f", got {said}")


def _bad(source: str, complaint: str) -> BadInputError:
    return BadInputError("bad_scene", f"{source}: {complaint}")
