"""What the server shares, and what each tab of a browser has for itself."""

import asyncio
import secrets
import tomllib
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from dem_jax.app import facts
from dem_jax.app.design import Design, draws_numbers, name_program, name_run_command, read_design
from dem_jax.app.facts import BucketCard, ProductCard
from dem_jax.app.folder import Folder
from dem_jax.app.helper import Answer, Helper
from dem_jax.app.jobs import Job, JobRunner
from dem_jax.app.workers import Drop
from dem_jax.errors import RecordError

STATIC = Path(__file__).parent / "static"
MOST_VIEWS = 16  # previews that are kept
PATIENCE = 0.7  # s without another change, before a program is compiled


class Workspace:
    """The folder, the helper process and the jobs of a server."""

    def __init__(self, folder: Folder, runner: JobRunner) -> None:
        self.folder = folder
        self.helper = Helper(str(folder.root))
        self.runner = runner
        self._expecting: asyncio.TimerHandle | None = None
        self._player = ""
        self._views: OrderedDict[str, str] = OrderedDict()
        self._first_answer: Answer | None = None  # the library's cards
        self._products: list[ProductCard] = []
        self._buckets: list[BucketCard] = []

    def start(self) -> None:
        """Start the processes that wait: for the first drop of a person who changes nothing."""
        self.runner.expect(describe_drop(Design()))
        self._first_answer = self.helper.submit(facts.describe_products)
        self.helper.submit(facts.prepare)

    def expect(self, design: Design) -> None:
        """Have a process ready for the drop of a design, unless another is expected in a moment."""
        if self._expecting is not None:
            self._expecting.cancel()
        drop = describe_drop(design)
        loop = asyncio.get_running_loop()
        self._expecting = loop.call_later(PATIENCE, self.runner.expect, drop)

    async def close(self) -> None:
        """End all processes, and wait for those of commands."""
        if self._expecting is not None:
            self._expecting.cancel()
        await self.runner.close()
        self.end()

    def end(self) -> None:
        """End the processes, and let those of commands save what they have."""
        self.runner.end()
        self.helper.close()

    async def list_products(self) -> list[ProductCard]:
        """Cards of the library, and of one's own products before them."""
        library = await self._list_library()
        return [
            *[await self.describe_product(name) for name in self.folder.list_products()],
            *library,
        ]

    async def _list_library(self) -> list[ProductCard]:
        if not self._products:
            answer = self._first_answer or self.helper.submit(facts.describe_products)
            self._first_answer = None
            self._products = await self.helper.receive(answer)
        return self._products

    async def describe_product(self, name: str) -> ProductCard:
        """The card of a product of the library or of one's own. Raises RecordError."""
        for card in await self._list_library():
            if card.name == name:
                return card
        path = str(self.folder.find_path(name)) if name.endswith(".toml") else name
        card = await self.helper.ask(facts.describe_own_product, path, name)
        return card._replace(notes=self.folder.shorten_paths(card.notes))

    async def list_buckets(self) -> list[BucketCard]:
        """The buckets of the library."""
        self._buckets = self._buckets or await self.helper.ask(facts.describe_buckets)
        return self._buckets

    async def write_player(self) -> str:
        """The page of the 3-D view."""
        if not self._player:
            script = (STATIC / "player.js").read_text(encoding="utf-8")
            self._player = await self.helper.ask(facts.write_empty_player, script)
        return self._player

    def keep_view(self, text: str) -> str:
        """Keep a view as JSON text; returns its key."""
        key = secrets.token_hex(8)
        self._views[key] = text
        while len(self._views) > MOST_VIEWS:
            self._views.popitem(last=False)
        return key

    def find_view(self, key: str) -> str | None:
        """A view that was kept; None: there is none."""
        return self._views.get(key)


def describe_drop(design: Design) -> Drop:
    """What a process prepares for the drop of a design."""
    drawn = draws_numbers(design)
    return Drop(design.to_toml(), design.seed, design.runs, name_program(design), drawn)


@dataclass
class Session:
    """What a tab of a browser has for itself: choices, the job of each page, the results that are
    shown and compared.
    """

    workspace: Workspace
    design: Design = field(default_factory=Design)
    shown: str = ""
    member: int | None = None
    compared: list[str] = field(default_factory=list)
    jobs: dict[str, Job] = field(default_factory=dict)
    opened_jobs: dict[str, str] = field(default_factory=dict)

    @property
    def folder(self) -> Folder:
        return self.workspace.folder

    def __setattr__(self, name: str, value: Any) -> None:
        """Set a field; a new design is prepared."""
        is_new = name == "design" and getattr(self, "design", None) not in (None, value)
        super().__setattr__(name, value)
        if is_new:
            self.workspace.expect(value)

    def next_command(self) -> list[str]:
        """The command of the next drop; the name in it may be taken by another tab meanwhile."""
        stem, number = self.design.stem, 1
        taken = {
            path.stem for path in self.folder.root.iterdir() if path.suffix in (".toml", ".h5")
        }
        while (candidate := stem if number == 1 else f"{stem}-{number}") in taken:
            number += 1
        return name_run_command(self.design, candidate)

    def reopen_scene(self, result: str) -> None:
        """Take up the choices of the scene of a result of this folder.

        Raises:
            RecordError: there is no such scene, or it names files elsewhere.
            SceneError: it has keys that the pages do not show.
        """
        path = self.folder.find_path(f"{Path(result).stem}.toml")
        try:
            tree = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise RecordError(
                f"{path.name} cannot be read; allowed: a scene of this folder"
            ) from error
        self.folder.check_references(tree)
        own = self.design
        self.design = replace(
            read_design(tree), runs=own.runs, seed=own.seed, uncertain=own.uncertain
        )

    def enter_drop(self) -> tuple[Job, str]:
        """Write the scene under a free name and enter its command; returns the job and the name of
        its results.
        """
        stem = self.folder.reserve_stem(self.design.stem, self.design.to_toml())
        command = name_run_command(self.design, stem)
        return self.workspace.runner.enter(command, describe_drop(self.design)), f"{stem}.h5"
