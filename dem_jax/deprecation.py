"""Names of the release before this one: they still work, with a DeprecationWarning of one line.

Modules that the documentation named have moved; a law of one's own may have the methods' former
names. Both end with the release after this one.
"""

import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

MOVED = {  # former module -> module, former name -> name
    "dem_jax.compiling": ("dem_jax.xla_flags", {"loops_as_one": "set_loop_flags"}),
    "dem_jax.contact": ("dem_jax.contacts", {}),
    "dem_jax.contact.law": ("dem_jax.contact_laws", {}),
    "dem_jax.contact.law.dashpot": ("dem_jax.contact_laws.dashpot", {"damped": "damped_force"}),
    "dem_jax.contact.of_run": (
        "dem_jax.contacts.batch_reduction",
        {
            "total": "sum_per_run",
            "largest": "max_per_run",
            "any_of": "any_per_run",
            "first_of": "first_index_per_run",
            "apart": "split_runs",
        },
    ),
}
LAW_METHODS = {"pair": "pair_parameters", "start": "init_history", "reach": "interaction_range"}


class FormerNameWarning(DeprecationWarning):
    """A name of the release before this one is used."""


def warn_of_name(former: str, name: str, hint: str = "") -> None:
    """Warn in one line that a former name ends with the next release; hint: ends the line."""
    warnings.warn(
        f"{former} is now {name}; the former name ends with the next release{hint}",
        FormerNameWarning,
        stacklevel=3,
    )


@contextmanager
def print_notes() -> Iterator[None]:
    """Print each warning of a former name once, as a note on stderr."""
    with warnings.catch_warnings():
        show = warnings.showwarning
        seen: set[str] = set()

        def show_note(message: Any, category: Any, *rest: Any, **more: Any) -> None:
            if not issubclass(category, FormerNameWarning):
                show(message, category, *rest, **more)
            elif str(message) not in seen:
                seen.add(str(message))
                print(f"note: {message}", file=sys.stderr)

        warnings.simplefilter("always", FormerNameWarning)
        warnings.showwarning = show_note
        yield


class _FormerModule(ModuleType):
    """A module under its former name: its names are those of the module that it is now."""

    def __getattr__(self, name: str) -> Any:
        module, names = MOVED[self.__name__]
        if name.startswith("__"):
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        submodule = f"{self.__name__}.{name}"
        return (
            import_module(submodule)
            if submodule in MOVED
            else getattr(import_module(module), names.get(name, name))
        )


class _FormerLoader(Loader):
    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _FormerModule(spec.name, f"{spec.name} is now {MOVED[spec.name][0]}.")

    def exec_module(self, module: ModuleType) -> None:
        warn_of_name(module.__name__, MOVED[module.__name__][0])


class _FormerFinder(MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname not in MOVED:
            return None
        return ModuleSpec(
            fullname,
            _FormerLoader(),
            is_package=any(name.startswith(f"{fullname}.") for name in MOVED),
        )


def install_former_modules() -> None:
    """Let ``import`` find modules by their former names."""
    if not any(isinstance(finder, _FormerFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _FormerFinder())


def accept_former_methods(law: Any) -> None:
    """Give the class of a law, the methods that it has by former names."""
    kind = type(law)
    for former, name in LAW_METHODS.items():
        if not hasattr(kind, name) and hasattr(kind, former):
            warn_of_name(f"{kind.__name__}.{former}", name)
            setattr(kind, name, getattr(kind, former))
