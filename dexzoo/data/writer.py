"""Writing a grasp set so that it is valid whenever the writing stops, and the same however it was done."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dexzoo.data.schema import SCHEMAS, SPLITS, VERSION

SHARD_SCENES = 50
"""Scenes of consecutive numbers that share a file."""
BY_SCENE = ("scenes", "views", "grasps")
MANIFEST = "manifest.json"
FIRST_EDITION = {"hand": "dlr2"}
"""Entries of the configuration that sets of the first edition do not name."""
_PARTS = ".scenes"  # scenes whose shard is not yet complete; readers of Parquet folders pass over hidden names

SceneRows = dict[str, pa.Table]
"""Rows of one scene in each of the tables scenes (one row), views and grasps."""


def scene_rows(scene: Mapping[str, Any], views: Sequence[Mapping[str, Any]] = (), grasps: Any = None) -> SceneRows:  # noqa: ANN401
    """The rows of a scene in the format's types; columns that are left out are null.

    Args:
        scene: Row of the scene.
        views: Rows of its views without scene and view, in order.
        grasps: Mapping of the grasps' columns without scene.

    Raises:
        ValueError: The format has no such column, or the split is none of the three.
    """
    if scene["split"] not in SPLITS:
        raise ValueError(f"scene {scene['scene']} has the split {scene['split']!r}; use one of {', '.join(SPLITS)}")
    rows = {
        "scenes": {name: [value] for name, value in scene.items()},
        "views": {name: [view.get(name) for view in views] for name in SCHEMAS["views"].names}
        | {"scene": [scene["scene"]] * len(views), "view": list(range(len(views)))},
    }
    tables = {name: _table(name, values) for name, values in rows.items()}
    return tables | {"grasps": grasp_rows(scene["scene"], dict(grasps or {}))}


def grasp_rows(scene: int, columns: Mapping[str, Any]) -> pa.Table:
    """Rows of the table of grasps, all of one scene; columns that are left out are null.

    Args:
        scene: Number of the scene.
        columns: Columns without scene; without any there are no rows.
    """
    count = len(next(iter(columns.values()))) if columns else 0
    return _table("grasps", {**columns, "scene": [scene] * count})


def _table(name: str, columns: Mapping[str, Any]) -> pa.Table:
    schema = SCHEMAS[name]
    if strange := set(columns) - set(schema.names):
        raise ValueError(f"the table {name} has no column {', '.join(sorted(strange))}")
    count = len(next(iter(columns.values()))) if columns else 0
    arrays = [
        pa.nulls(count, field.type) if field.name not in columns else _array(columns[field.name], field.type)
        for field in schema
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def _array(values: Any, kind: pa.DataType) -> pa.Array:  # noqa: ANN401, whatever holds a column
    if isinstance(values, np.ndarray) and values.ndim == 2:
        return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1]).cast(kind)
    return pa.array(values, kind, from_pandas=True)  # NaN means not known, as null does


class GraspSetWriter:
    """A grasp set that is being written; one process at a time, held by a lock.

    A scene goes to a folder of its own, whole or not at all; once all scenes of a shard are there, they are gathered
    into one file for each table. The files depend on the scenes alone, not on their order or on interruptions.

    Args:
        folder: Folder of the set.
        configuration: Configuration of the rows; it must be that of the rows that are there already.
        num_scenes: The set shall hold scenes 0 to num_scenes - 1; it may be larger than it was before.
        objects: Rows of the table of objects.

    Attributes:
        done: Numbers of the scenes that are there.

    Raises:
        FileNotFoundError: A file of the manifest is missing.
        ValueError: The folder is of another configuration, or no grasp set.
        OSError: The folder cannot be written.
        RuntimeError: Another process is writing to it.
    """

    def __init__(
        self,
        folder: Path,
        configuration: Mapping[str, Any],
        num_scenes: int,
        objects: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        self.folder, self.num_scenes = folder, num_scenes
        self._parts = folder / _PARTS
        try:
            self._parts.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OSError(f"grasp set {folder} cannot be written: {error.strerror}; choose another folder") from None
        self._lock = _lock(folder)
        for leftover in (*folder.glob(".*.partial"), *folder.glob("*/.*.partial"), *folder.glob(f"{_PARTS}/.*")):
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        self.manifest = self._open_manifest(json.loads(json.dumps(configuration)))
        if objects and not (folder / "objects").exists():
            named = {name: [row.get(name) for row in objects] for name in SCHEMAS["objects"].names}
            self._write_table("objects", "00000", _table("objects", named))
        self.done = {int(path.name) for path in self._parts.iterdir()}
        for path in self._files("scenes"):
            self.done |= set(pq.read_table(path, columns=["scene"])["scene"].to_pylist())
        for shard in sorted({int(path.name) // SHARD_SCENES for path in self._parts.iterdir()}):
            self._gather_if_complete(shard)

    def __enter__(self) -> GraspSetWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        with suppress(OSError):  # scenes of an unfinished shard are still in it
            self._parts.rmdir()
        os.close(self._lock)

    def write(self, rows: SceneRows) -> None:
        """Add one scene; when this returns it is on disk.

        Args:
            rows: Rows of the scene.
        """
        scene = int(rows["scenes"]["scene"][0].as_py())
        temporary, final = self._parts / f".{scene:06d}", self._parts / f"{scene:06d}"
        temporary.mkdir()
        try:
            for name in BY_SCENE:
                _write(temporary / f"{name}.parquet", _encode(rows[name]))
            _sync(temporary)
            temporary.rename(final)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
        _sync(self._parts)
        self.done.add(scene)
        self._gather_if_complete(scene // SHARD_SCENES)

    def _gather_if_complete(self, shard: int) -> None:
        """Move the scenes of a shard into its files, if all are there."""
        numbers = range(shard * SHARD_SCENES, min((shard + 1) * SHARD_SCENES, self.num_scenes))
        if not numbers or not self.done.issuperset(numbers):
            return
        # one that was gathered when the set was smaller is opened again
        parts = sorted(path for path in self._parts.iterdir() if int(path.name) // SHARD_SCENES == shard)
        new = [int(path.name) for path in parts]
        for name in BY_SCENE:
            tables = [pq.read_table(path / f"{name}.parquet") for path in parts]
            old = self.folder / name / f"{shard:05d}.parquet"
            if old.exists():
                table = pq.read_table(old)
                tables.append(table.filter(~np.isin(table["scene"].to_numpy(), new)))
            joined = pa.concat_tables(tables)
            order = np.argsort(joined["scene"].to_numpy(), kind="stable")
            self._write_table(name, f"{shard:05d}", joined.take(order), save=False)
        self._save()
        for path in parts:
            shutil.rmtree(path)

    def add_grasps(self, part: str, grasps: pa.Table) -> None:
        """Add grasps of scenes that are there as a file of their own, replacing it if there.

        Args:
            part: Name of the file, grasps/PART.parquet.
            grasps: Rows of the table of grasps.
        """
        self._write_table("grasps", part, grasps.cast(SCHEMAS["grasps"]))

    def settle(self, name: str, value: Mapping[str, Any]) -> None:
        """Add the settings of a part to the configuration.

        Args:
            name: Name of the part.
            value: Its settings.

        Raises:
            ValueError: The part was begun with other settings.
        """
        there = self.manifest["configuration"].setdefault(name, dict(value))
        other = sorted(key for key in there.keys() | value.keys() if there.get(key) != value.get(key))
        if other:
            was, now = ({key: made.get(key) for key in other} for made in (there, value))
            raise ValueError(f"{name} of grasp set {self.folder} was made with {was}, not {now}")

    def _write_table(self, name: str, shard: str, table: pa.Table, save: bool = True) -> None:
        path = self.folder / name / f"{shard}.parquet"
        path.parent.mkdir(exist_ok=True)
        content = _encode(table)
        _replace(path, content)
        key = path.relative_to(self.folder).as_posix()
        self.manifest["files"][key] = {"rows": table.num_rows, "sha256": hashlib.sha256(content).hexdigest()}
        if save:
            self._save()

    def _files(self, name: str) -> list[Path]:
        return [self.folder / key for key in sorted(self.manifest["files"]) if key.startswith(f"{name}/")]

    def _open_manifest(self, configuration: dict[str, Any]) -> dict[str, Any]:
        path = self.folder / MANIFEST
        if not path.exists():
            others = [other.name for other in self.folder.iterdir() if other.name != _PARTS]
            if others:
                raise ValueError(f"{self.folder} holds {others[0]} and is no grasp set; give a new or an empty folder")
            manifest: dict[str, Any] = {
                "format": "dexzoo.grasp_set",
                "version": VERSION,
                "configuration": configuration,
                "counts": {},
                "files": {},
            }
            _replace(path, _json(manifest))
            return manifest
        manifest = read_manifest(path.read_bytes(), str(path))
        for name, value in configuration.items():
            there = manifest["configuration"].get(name, FIRST_EDITION.get(name))
            if there != value:
                raise ValueError(
                    f"grasp set {self.folder} was made with {name} {there!r}, not {value!r}; go on with the same or "
                    "give another folder"
                )
        for key in manifest["files"]:
            if not (self.folder / key).exists():
                raise FileNotFoundError(f"grasp set {self.folder} has lost {key}, which its manifest names; restore it")
        return manifest

    def _save(self) -> None:
        """Write the manifest with the counts of the gathered scenes."""
        generated = held = 0
        skipped: Counter[str] = Counter()
        kept = 0
        for path in self._files("scenes"):
            table = pq.read_table(path, columns=["generated", "held", "skipped"]).to_pydict()
            generated += sum(value or 0 for value in table["generated"])
            held += sum(value or 0 for value in table["held"])
            kept += sum(reason is None for reason in table["skipped"])
            skipped.update(reason for reason in table["skipped"] if reason is not None)
        rows: Counter[str] = Counter()
        for key, file in self.manifest["files"].items():
            rows[key.split("/")[0]] += file["rows"]
        self.manifest["counts"] = {
            "scenes": kept,
            "skipped": dict(sorted(skipped.items())),
            "views": rows["views"],
            "grasps": rows["grasps"],
            "generated": generated,
            "held": held,
        }
        self.manifest["files"] = dict(sorted(self.manifest["files"].items()))
        _replace(self.folder / MANIFEST, _json(self.manifest))


def read_manifest(content: bytes, where: str) -> dict[str, Any]:
    """Read a manifest.

    Args:
        content: Its bytes.
        where: Its place, for errors.

    Raises:
        ValueError: It is no manifest of this version.
    """
    try:
        manifest = json.loads(content)
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{where} is not JSON: {error}") from None
    if not isinstance(manifest, dict) or manifest.get("format") != "dexzoo.grasp_set":
        raise ValueError(f"{where} is no manifest of a grasp set")
    if manifest.get("version") != VERSION:
        raise ValueError(f"{where} is of format version {manifest.get('version')}; this dexzoo reads version {VERSION}")
    return manifest


def _lock(folder: Path) -> int:
    """Hold the folder until the process ends, however it ends."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise RuntimeError(f"another process is writing to the grasp set {folder}; wait for it or end it") from None
    return handle


def _encode(table: pa.Table) -> bytes:
    """A Parquet file of one row group, whose bytes depend on the rows only."""
    sink = pa.BufferOutputStream()
    # a dictionary of single floats would hide from zstd that whole poses come again: 178 bytes a grasp instead of 104
    plain = [field.name for field in table.schema if not pa.types.is_fixed_size_list(field.type)]
    pq.write_table(table.combine_chunks(), sink, use_dictionary=plain, compression="zstd", compression_level=9)
    return bytes(sink.getvalue().to_pybytes())


def _json(manifest: dict[str, Any]) -> bytes:
    return (json.dumps(manifest, indent=2) + "\n").encode()


def _replace(path: Path, content: bytes) -> None:
    """Write a file whole or not at all."""
    temporary = path.with_name(f".{path.name}.partial")
    try:
        _write(temporary, content)
        temporary.rename(path)
    finally:
        temporary.unlink(missing_ok=True)
    _sync(path.parent)


def _write(path: Path, content: bytes) -> None:
    try:
        with path.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise OSError(f"{path.parent} cannot be written: {error.strerror}; what is finished is kept") from None


def _sync(folder: Path) -> None:
    """Make a rename in this folder outlast a loss of power."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
