"""The folder that holds everything: scenes and products as TOML, STL files, results as HDF5."""

import os
import re
import secrets
import struct
import tomllib
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from dem_jax.errors import RecordError

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,79}")
PRODUCTS, BUCKETS = "products", "buckets"  # folders of a person's own
RESULTS = (".h5", ".hdf5", ".hdf")
LARGEST_STL = 50 * 2**20  # bytes
PATH_KEYS = ("base", "product", "bucket", "stl", "flap_stl")  # keys of a scene that may name a file


class Folder:
    """A folder of results. No method reads or writes outside of it."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root).expanduser().resolve()
        try:
            self.root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordError(
                f"{root}: {error.strerror}; allowed: a folder that can be written"
            ) from error
        if not os.access(self.root, os.W_OK):
            raise RecordError(
                f"{root}: it cannot be written; allowed: a folder that can be written"
            )

    def find_path(self, name: str) -> Path:
        """The path of a file in the folder, from the root.

        Args:
            name: relative to the folder.

        Raises:
            RecordError: it is outside of the folder, directly or by a link, or its name is not
            plain.
        """
        parts = name.split("/")
        if len(parts) > 2 or not all(NAME.fullmatch(part) for part in parts):
            raise RecordError(f"{name!r}: allowed: a name of letters, digits, '.', '_' and '-'")
        path = self.root / name
        if not path.resolve().is_relative_to(self.root):
            raise RecordError(f"{name!r} leads out of the folder")
        return path

    def shorten_paths(self, lines: list[str]) -> list[str]:
        """Lines in which files of the folder are named from there."""
        return [line.replace(f"{self.root}{os.sep}", "") for line in lines]

    def list_results(self) -> list[str]:
        """Names of the files of results, the newest first."""
        return self._list("", RESULTS)

    def list_scenes(self) -> list[str]:
        """Names of the scenes, the newest first."""
        return [
            name
            for name in self._list("", (".toml",))
            if "base" in self.find_path(name).read_text(encoding="utf-8", errors="replace")
        ]

    def list_products(self) -> list[str]:
        """Names of the products of one's own, relative to the folder."""
        return self._list_own(PRODUCTS)

    def list_buckets(self) -> list[str]:
        """Names of the buckets of one's own, relative to the folder."""
        return self._list_own(BUCKETS)

    def list_files(self, ending: str, begins: str) -> list[str]:
        """Names of the files with an ending that begin so, the newest first."""
        return [name for name in self._list("", (ending,)) if name.startswith(begins)]

    def zip_folder(self, name: str, target: str) -> None:
        """Put the files of a folder into a ZIP file. Raises RecordError."""
        folder = self.find_path(name)
        with zipfile.ZipFile(self.find_path(target), "w", zipfile.ZIP_DEFLATED) as file:
            for path in sorted(folder.iterdir()):
                file.write(path, path.name)

    def list_parts(self, name: str) -> list[str]:
        """Names of a scene and of the files in the folder that it needs, whoever names them."""
        found = [name]
        for each in found:  # which grows
            tree = {}
            if each.endswith(".toml"):
                tree = tomllib.loads((self.root / each).read_text(encoding="utf-8"))
            for _, value in _list_references(tree):
                path = (self.root / each).parent / value.partition(":")[0]
                if path.is_file() and path.resolve().is_relative_to(self.root):
                    part = path.resolve().relative_to(self.root).as_posix()
                    found += [part] if part not in found else []
        return found

    def zip_files(self, names: list[str], target: str) -> None:
        """Put files into a ZIP file, under their names. Raises RecordError."""
        with zipfile.ZipFile(self.find_path(target), "w", zipfile.ZIP_DEFLATED) as file:
            for name in names:
                file.write(self.find_path(name), name)

    def _list(self, below: str, endings: tuple[str, ...]) -> list[str]:
        folder = self.root / below
        if not folder.is_dir():
            return []
        found = []
        for path in folder.iterdir():
            name = path.relative_to(self.root).as_posix()
            is_plain = path.suffix.lower() in endings and NAME.fullmatch(path.name)
            if is_plain and path.is_file() and path.resolve().is_relative_to(self.root):
                found.append((path.stat().st_mtime_ns, name))
        return [name for _, name in sorted(found, reverse=True)]

    def _list_own(self, below: str) -> list[str]:
        """Names of the TOML files below the folder that can be read and name no file outside."""
        found = []
        for name in self._list(below, (".toml",)):
            with suppress(OSError, ValueError, RecordError):
                text = (self.root / name).read_text(encoding="utf-8")
                self.check_references(tomllib.loads(text), below)
                found.append(name)
        return found

    def reserve_stem(
        self, stem: str, text: str, ending: str = ".toml", others: tuple[str, ...] = (".h5",)
    ) -> str:
        """Write a text under a name that no file has yet; two servers never get the same one.

        Args:
            stem: how the name begins, and perhaps its folder; a number follows.
            text: of the file.
            ending: of the file.
            others: endings of files that the name must be free for, too.

        Returns:
            The name without its ending, relative to the folder.

        Raises:
            RecordError: it cannot be written.
        """
        for candidate in _number_stems(stem):
            path = self.find_path(f"{candidate}{ending}")
            path.parent.mkdir(exist_ok=True)
            if any(path.with_name(path.stem + other).exists() for other in others):
                continue
            try:
                with open(path, "x", encoding="utf-8") as file:
                    file.write(text)
            except FileExistsError:
                continue
            except OSError as error:
                raise RecordError(f"{path.name}: {error.strerror}") from error
            return candidate
        raise AssertionError  # there is always another number

    def store_upload(self, below: str, file_name: str, content: bytes) -> str:
        """Store an uploaded STL under a free name; returns it, relative to the folder. Raises
        RecordError.
        """
        check_stl(file_name, content)
        stem = clean_stem(Path(file_name).stem)
        for candidate in _number_stems(f"{below}/{stem}"):
            path = self.find_path(f"{candidate}.stl")
            path.parent.mkdir(exist_ok=True)
            if path.with_suffix(".toml").exists():
                continue
            try:
                with open(path, "xb") as file:
                    file.write(content)
            except FileExistsError:
                continue
            except OSError as error:
                raise RecordError(f"{path.name}: {error.strerror}") from error
            return f"{candidate}.stl"
        raise AssertionError

    def replace_text(self, name: str, text: str) -> None:
        """Write a text file whole or not at all. Raises RecordError."""
        path = self.find_path(name)
        path.parent.mkdir(exist_ok=True)
        part = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
        try:
            part.write_text(text, encoding="utf-8")
            part.replace(path)
        except OSError as error:
            raise RecordError(f"{name}: {error.strerror}") from error

    def check_references(self, tree: object, below: str = "") -> None:
        """Raise RecordError where the tree of a file, below the folder, names one outside of it."""
        for key, value in _list_references(tree):
            is_file = "/" in value or "\\" in value or value.lower().endswith((".toml", ".stl"))
            path = self.root / below / value.partition(":")[0]
            if is_file and not path.resolve().is_relative_to(self.root):
                raise RecordError(
                    f"{key} = {value!r} leads out of the folder; allowed: files in it"
                )


def clean_stem(text: str) -> str:
    """A text as part of a file's name."""
    plain = re.sub(r"[^A-Za-z0-9_-]+", "-", text).strip("-_.")[:40]
    return plain if plain and NAME.fullmatch(plain) else "part"


def check_stl(file_name: str, content: bytes) -> None:
    """Raise RecordError for an upload that is too large or is no STL file."""
    if not file_name.lower().endswith(".stl"):
        raise RecordError(f"{file_name}: allowed: STL files")
    if len(content) > LARGEST_STL:
        raise RecordError(
            f"{file_name}: {len(content) / 2**20:.0f} MB; allowed: up to {LARGEST_STL // 2**20} MB"
        )
    is_binary = (
        len(content) >= 84 and len(content) == 84 + 50 * struct.unpack("<I", content[80:84])[0]
    )
    if not is_binary and not (
        content.lstrip()[:5].lower() == b"solid" and b"facet" in content[:4096].lower()
    ):
        raise RecordError(f"{file_name}: it is no STL file, neither binary nor text")


def _number_stems(stem: str) -> Iterator[str]:
    """The stem itself, then with a number behind it."""
    yield stem
    number = 2
    while True:
        yield f"{stem}-{number}"
        number += 1


def _list_references(tree: object, key: str = "") -> Iterator[tuple[str, str]]:
    """(key, text) of the keys in a tree that may name a file."""
    if isinstance(tree, dict):
        for name, item in tree.items():
            yield from _list_references(item, name)
    elif isinstance(tree, list | tuple):
        for item in tree:
            yield from _list_references(item, key)
    elif isinstance(tree, str) and key in PATH_KEYS:
        yield key, tree
