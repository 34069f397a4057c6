"""Quantities and units in the header of a table, as instruments and people write them."""

import re
from dataclasses import dataclass

GRAVITY = 9.81  # m/s2: between weight and force, as eq. 24
POUND = 0.45359237  # kg

# Symbols count as they are written: mN is not MN, and mg is not Mg.
TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
FORCE = {"N": 1.0, "mN": 1e-3, "cN": 1e-2, "daN": 10.0, "kN": 1e3, "uN": 1e-6}
MASS = {"kg": 1.0, "g": 1e-3, "mg": 1e-6, "lb": POUND, "oz": POUND / 16.0}
WORDS = {
    "s": "sec secs second seconds sek sekunde sekunden seconde secondes segundo segundos secondo secondi",
    "ms": "msec msecs millisecond milliseconds millisec millisekunde millisekunden milliseconde "
    "millisecondes milisegundo milisegundos millisecondo millisecondi",
    "us": "usec µsec microsecond microseconds microsec mikrosekunde mikrosekunden microseconde "
    "microsecondes microsegundo microsegundos microsecondo microsecondi",
    "ns": "nsec nanosecond nanoseconds nanosekunde nanosekunden",
    "min": "mins minute minutes minuten",
    "N": "newton newtons",
    "mN": "millinewton millinewtons",
    "daN": "dekanewton decanewton decanewtons",
    "kN": "kilonewton kilonewtons",
    "uN": "micronewton micronewtons mikronewton",
    "kg": "kilogram kilograms kilogramm kilogramme kilogrammes kilogramo kilogramos kilo kilos kgs "
    "kgf kp kilopond kilogram-force",
    "g": "gram grams gramm gramme grammes gramo gramos grammo grammi gr gf gram-force pond",
    "mg": "milligram milligrams milligramm milligramme",
    "lb": "lbs lbf pound pounds pound-force",
    "oz": "ozf ounce ounces ounce-force",
}
OTHER = (
    "c f k °c °f degc degf celsius kelvin v mv uv volt volts millivolt millivolts a ma ampere amperes w kw j "
    "pa hpa kpa mpa bar mbar psi mm cm m um km in inch ft mm/s m/s cm/s km/h m/s2 m/s^2 m/s² mm/s2 mm/s² "
    "m/s**2 g's gs gn g0 deg ° rad grad degree degrees % percent hz khz mhz rpm 1/min 1/s deg/s °/s rad/s nm n·m n*m "
    "nmm ohm kohm ω db v/v mv/v uv/v um/m µm/m ue ustrain strain bit bits digit digits count counts raw adc - 1 "
    "bool l l/min ml m3 kg/h g/s kg/s n/mm n/m n/mm2 n/mm² rn"
).split()
ALIASES = {word: symbol for symbol, words in WORDS.items() for word in words.split()}
# Symbols that stay clear when all is written in capitals, or in none ("n" of force_n).
LOOSE = {name.lower(): name for name in (*TIME, *FORCE, *MASS)} | {"newton": "N"}
# may mean something else
NOT_LOOSE = ("MN", "Mn", "Mg", "MG", "G", "CN", "UN", "Min", "NS", "nS", "mS", "Ms")

TIME_NAMES = (
    "time t zeit temps tiempo tempo tijd tid x-value x_value xvalue timestamp zeitstempel elapsed uhrzeit clock "
    "messzeit relzeit reltime abszeit abstime zeitachse timebase"
).split()
INDEX_NAMES = (
    "no no. nr nr. n° № # num number nummer index idx row row# rows zeile sample samples scan scan# point "
    "points punkt record rec id messwert count zähler counter n° position lfd lfd. i"
).split()
FORCE_NAMES = (
    "force kraft load last f fx fy fz fn pif impact aufprallkraft aufprall loadcell lc zelle wägezelle "
    "waegezelle wägezellensignal cell scale waage wb"
).split()
WEIGHT_NAMES = "weight gewicht mass masse poids peso massa wägewert gross net brutto netto".split()
OTHER_NAMES = (
    "acceleration accel accelerometer acc beschleunigung accélération aceleración accelerazione shock vibration "
    "schwingung temp temperature temperatur voltage spannung volt current strom pressure druck displacement weg "
    "path position distance abstand hub angle winkel speed velocity geschwindigkeit humidity feuchte status flag "
    "state trigger trig valve ventil event marker comment kommentar remark bemerkung channel_status alarm error "
    "fehler strain dehnung torque moment drehmoment flow durchfluss encoder rpm drehzahl frequency frequenz "
    "quality"
).split()


@dataclass(frozen=True)
class Unit:
    """A unit of a column.

    kind: "time", "force", "mass", "other", "unknown" or "none"; symbol: as shown to people;
    factor: to s, N or kg.
    """

    kind: str
    symbol: str = ""
    factor: float = 1.0

    @property
    def newtons(self) -> float:
        """Value of one unit in N; for a unit of mass its weight."""
        return self.factor * (GRAVITY if self.kind == "mass" else 1.0)


NONE = Unit("none")


def unit_named(text: str) -> Unit:
    """The unit that `text` writes, without brackets; "unknown" if it is none of the known ones."""
    text = _tidy(text)
    if not text:
        return NONE
    symbol = text if text in (*TIME, *FORCE, *MASS) else ALIASES.get(text.lower(), "")
    if not symbol and text not in NOT_LOOSE:
        symbol = LOOSE.get(text.lower(), "")
    for kind, known in (("time", TIME), ("force", FORCE), ("mass", MASS)):
        if symbol in known:
            return Unit(kind, symbol, known[symbol])
    return Unit("other" if text.lower() in OTHER or text == "G" else "unknown", text)


def _tidy(text: str) -> str:
    text = text.strip().strip("\"'").strip()
    text = re.sub(r"^[\[({<]\s*(.*?)\s*[\])}>]$", r"\1", text)
    return re.sub(r"^[µμ](?=[sN]|sec)", "u", text)


def is_bare_unit(cell: str) -> bool:
    """Whether a cell of a header holds a unit of time, force or mass alone, with or without
    brackets.
    """
    return unit_named(cell).kind in ("time", "force", "mass")


def unit_in_name(name: str) -> Unit:
    """The unit in a name such as "Force [kN]", "time_s", "F/N", "Time, s" or "t in ms".

    Text in brackets, behind a slash or behind "in" is a unit, known or not; a last word only where
    it is a known one.
    """
    inside = [
        unit_named(text) for text in re.findall(r"[\[({<]\s*([^\[\](){}<>]+?)\s*[\])}>]", name)
    ]
    if inside:
        known = [unit for unit in inside if unit.kind not in ("unknown", "other")]
        known = known or [unit for unit in inside if unit.kind == "other"]
        return (known or inside)[-1]
    whole = unit_named(name.split()[-1]) if name.split() else NONE
    if "/" in whole.symbol and whole.kind == "other":
        return whole
    if found := re.search(r"(?:/|\bin\b|\bIN\b)\s*([^\s/]+)\s*$", name):
        return unit_named(found.group(1))
    last = re.split(r"[_,:=\s-]+", name.strip())[-1]
    unit = unit_named(last) if last != name.strip() else NONE
    if unit.kind == "time" and quantity_named(name) not in ("time", ""):  # "Force min"
        return NONE
    return unit if unit.kind not in ("unknown", "other") else NONE


def quantity_named(name: str) -> str:
    """Quantity of a column by its name: "time", "index", "force", "weight", "other" or ""
    (unknown)."""
    plain = re.sub(r"[\[({<].*?[\])}>]", " ", name).strip().lower()
    words = [word for word in re.split(r"[\s_/,;:=-]+", plain) if word]
    joined = {plain, *words, *(re.sub(r"\d+$", "", word) for word in words)}
    if (
        words
        and (words[0] in TIME_NAMES or plain in TIME_NAMES)
        or joined & {"timestamp", "uhrzeit"}
    ):
        return "time"
    if joined & set(OTHER_NAMES) or plain in ("ax", "ay", "az"):
        return "other"
    if joined & set(WEIGHT_NAMES):
        return "weight"
    if joined & set(FORCE_NAMES) or any(part in plain for part in ("force", "kraft", "load")):
        return "force"
    if plain in INDEX_NAMES or words and words[0] in INDEX_NAMES or words[:2] == ["row", "number"]:
        return "index"
    return ""
