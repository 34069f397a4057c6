"""Page 1: the product, of the library, of an STL file or a mixture, and its material."""

from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path

from nicegui import ui

from dem_jax.app import facts
from dem_jax.app.design import FIELDS, MATERIAL_FIELDS, drop_wrong_changes, write_product
from dem_jax.app.facts import ProductCard, StlFacts
from dem_jax.app.folder import PRODUCTS
from dem_jax.app.pages import parts
from dem_jax.app.pages.uploads import show_stl_upload, show_unit
from dem_jax.app.session import Session
from dem_jax.errors import RecordError, SceneError
from dem_jax.scene.library import load_product

DENSITIES = (10.0, 12e3)  # kg/m3, of what is weighed


async def show_product(session: Session) -> None:
    """The page."""
    parts.show_title(
        "Product", "Choose what falls: a product of the library, a part of your own, or a mixture."
    )
    with ui.element("div").classes("columns product"):
        with ui.element("section").classes("wide"):
            cards = ui.element("div")
        side = ui.element("section").classes("side").props('aria-label="Chosen product"')

    async def refresh() -> None:
        side.clear()
        with side:
            await _show_choice(session, refresh)
        cards.clear()
        with cards:
            await _show_cards(session, refresh)

    await refresh()


async def _show_cards(session: Session, refresh: Callable[[], Awaitable[None]]) -> None:
    """An STL of one's own, and the products as cards that can be chosen."""
    _show_upload(session, refresh)
    parts.show_heading("Library")
    search = (
        ui.input("Search the library")
        .props("outlined dense clearable type=search")
        .classes("search")
    )
    grid = ui.element("div").classes("cards").props('role=list aria-label="Products"')
    chosen = {name for name, _ in session.design.products}
    shown: list[tuple[ui.element, str]] = []
    with grid:
        for card in await session.workspace.list_products():
            shown.append(
                (
                    _show_card(session, card, card.name in chosen, refresh),
                    f"{card.name} {card.text}".lower(),
                )
            )

    def filter_cards() -> None:
        for element, text in shown:
            element.set_visibility((search.value or "").lower() in text)

    search.on_value_change(filter_cards)


def _show_card(
    session: Session, card: ProductCard, is_chosen: bool, refresh: Callable[[], Awaitable[None]]
) -> ui.element:
    async def choose() -> None:
        session.design = session.design.with_product(card.name)
        await refresh()

    async def mix() -> None:
        rows = [row for row in session.design.products if row[0] != card.name]
        session.design = replace(session.design, products=(*rows, (card.name, 1.0)))
        await refresh()

    title, _, text = card.text.partition(": ")
    with (
        ui.element("div")
        .classes("card chosen" if is_chosen else "card")
        .props("role=listitem") as box
    ):
        with (
            ui.element("button")
            .classes("card-main")
            .props(f"type=button aria-pressed={str(is_chosen).lower()}") as main
        ):
            ui.html(card.picture, sanitize=False).classes("picture")
            ui.label(title).classes("card-title")
            ui.label(f"{card.weight:.3g} g · {text}").classes("card-text")
        main.on("click", choose)
        if not is_chosen:
            add = ui.button("Add to mixture", on_click=mix).props("flat dense no-caps size=sm")
            add.props(f'aria-label="Add {title} to the mixture"')
    return box


async def _show_choice(session: Session, refresh: Callable[[], Awaitable[None]]) -> None:
    """The chosen product or mixture: evidence, material, command."""
    design = session.design
    try:
        scene = drop_wrong_changes(design, session.folder.root).read_scene(session.folder.root)
    except SceneError as error:
        parts.show_error(str(error))
        return
    if design.product is None:
        _show_mixture(session, refresh)
        parts.show_command([session.next_command()])
        return
    card = await session.workspace.describe_product(design.product)
    parts.show_heading(card.text.partition(": ")[0])
    ui.html(card.picture, sanitize=False).classes("picture large")
    ui.label(f"{card.weight:.4g} g a piece: {card.text.partition(': ')[2]}").classes("lead")
    parts.show_lines(card.notes)
    if card.states:
        _show_states(session, card, refresh)
    with ui.expansion("Where the numbers come from").classes("more"):
        parts.show_table(["number", "value", "5 to 95 %", "source"], card.rows)
        ui.label(
            "A: measured on the product; B: measured on a close relative; C: judgement"
        ).classes("small")
    with ui.expansion("Material", value=False).classes("more"):
        ranges = {
            f"material.{row[0].split(' (')[0].replace(' ', '_')}": row
            for row in card.rows
            if row[2]
        }
        notes = {key: _describe_range(key, row) for key, row in ranges.items()}
        fields = parts.Fields(session, _update_command)
        fields.show(MATERIAL_FIELDS, scene, notes)
    ui.button("Next: bucket and release", on_click=lambda: ui.navigate.to("/bucket")).props(
        "no-caps unelevated"
    )
    parts.show_command([session.next_command()])


async def _update_command() -> None:
    """The command names the scene's file, which a changed material does not change."""


def _describe_range(key: str, row: tuple[str, str, str, str]) -> str:
    """The range of a number of the product in the unit that is shown."""
    field = FIELDS.get(key)
    factor, unit = (field.factor, field.unit) if field else (1.0, "")
    low, high = (float(each) / factor for each in row[2].split(" to "))
    return (
        f"Of this product 5 to 95 %: {low:.3g} to {high:.3g} {unit}".rstrip() + f" ({row[3][0]})."
    )


def _show_states(
    session: Session, card: ProductCard, refresh: Callable[[], Awaitable[None]]
) -> None:
    """Buttons of the further states of a product."""

    async def choose(state: str) -> None:
        session.design = session.design.with_product(f"{card.name}:{state}")
        await refresh()

    with ui.element("div").classes("line"):
        ui.label("Other states:")
        for state in card.states:
            ui.button(state, on_click=lambda _, state=state: choose(state)).props(
                "outline dense no-caps"
            )


def _show_mixture(session: Session, refresh: Callable[[], Awaitable[None]]) -> None:
    """The products of a mixture with their shares by weight."""

    def set_share(name: str, share: float | None) -> None:
        if share and share > 0:
            rows = tuple(
                (each, float(share) if each == name else old)
                for each, old in session.design.products
            )
            session.design = replace(session.design, products=rows)

    async def drop(name: str) -> None:
        rows = tuple(row for row in session.design.products if row[0] != name)
        session.design = replace(session.design, products=rows)
        await refresh()

    parts.show_heading("Mixture")
    for name, share in session.design.products:
        with ui.element("div").classes("line"):
            box = ui.number(f"Share of {Path(name).stem}", value=share, min=0.01, step=0.5)
            box.props(
                'outlined dense hint="By weight, relative to the others. Allowed: above 0."'
            ).classes("field")
            box.on_value_change(lambda e, name=name: set_share(name, e.value))
            remove = ui.button(icon="close", on_click=lambda _, name=name: drop(name)).props(
                "flat round dense"
            )
            remove.props(f'aria-label="Remove {Path(name).stem}"')
    ui.button("Next: bucket and release", on_click=lambda: ui.navigate.to("/bucket")).props(
        "no-caps unelevated"
    )


def _show_upload(session: Session, refresh: Callable[[], Awaitable[None]]) -> None:
    """An STL file that becomes a product."""
    parts.show_heading("Your own part")
    show_stl_upload(
        session,
        PRODUCTS,
        "Drop an STL file of one piece here",
        facts.describe_stl,
        lambda name, found: _show_stl(session, name, found, refresh),
    )


def _show_stl(
    session: Session, name: str, found: StlFacts, refresh: Callable[[], Awaitable[None]]
) -> None:
    """What an STL holds, and what it does not say: unit, weight and material."""
    stem = Path(name).stem
    with ui.element("div").classes("panel"):
        parts.show_heading(f"Read: {stem}")
        size = ui.label()
        parts.show_lines([*found.notes, describe_excess(found)])
        unit = show_unit(found.unit)
        weight = ui.number("Weight of a piece (g)", value=None, step=0.1)
        weight.props('outlined dense hint="An STL has no weight; it gives the density."').classes(
            "field"
        )
        like = ui.select(
            {card: card for card in _library_names()},
            value="nugget",
            label="Material like",
            with_input=True,
        )
        like.props(
            'outlined dense hint="Stiffness, restitution and friction of this product."'
        ).classes("field")

        def write_size() -> None:
            edges = " × ".join(f"{1e3 * unit.value * edge:.4g}" for edge in found.size)
            grams = 1e6 * found.volume * unit.value**3
            size.set_text(f"{edges} mm; of the density of water it would weigh {grams:.3g} g")

        unit.on_value_change(write_size)
        write_size()
        wrong = ui.label().classes("error").props("role=alert")

        async def use() -> None:
            wrong.set_text("")
            weight.error = find_weight_error(weight.value, found.volume * unit.value**3)
            if weight.error:
                return
            tree = load_product(like.value, "products")
            text = write_product(
                f"{stem}.stl", unit.value, 1e-3 * weight.value, found.is_hull, tree
            )
            product = f"{PRODUCTS}/{stem}.toml"
            button.props("loading")
            try:
                session.folder.replace_text(product, text)
                await session.workspace.describe_product(product)
            except RecordError as error:
                session.folder.find_path(product).unlink(missing_ok=True)
                wrong.set_text(str(error))
                button.props(remove="loading")
            else:
                session.design = session.design.with_product(product)
                await refresh()

        button = ui.button("Use this part", on_click=use).props("no-caps unelevated")


def find_weight_error(weight: float | None, volume: float) -> str | None:
    """What is wrong with the weight (g) of a piece of a volume (m3); None: nothing."""
    low, high = (1e3 * density * volume for density in DENSITIES)
    if weight and low <= weight <= high:
        return None
    return f"Allowed: {low:.3g} to {high:.3g} g, as of puffs and of lead"


def describe_excess(found: StlFacts) -> str:
    """By how much the hull of a body is larger than the body, and what follows."""
    if found.excess < 1e-6:
        return "it is convex"
    use = "so the hull stands for it" if found.is_hull else "so it is cut into convex parts"
    return f"its hull has {100 * found.excess:.2g} % more volume, {use}"


def _library_names() -> list[str]:
    from dem_jax.scene import library

    return list(library.list_products())
