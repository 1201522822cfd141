"""The verdict of a report, in words: what summary.json says, as sentences."""

import math
from dataclasses import dataclass
from typing import Any

from uwsfm.models.ports.port import kind_of_word
from uwsfm.results.verdict_summary import DOUBTFUL_WORD, WITHHELD, verdict_line

ARBITRARY_UNIT = "scale arbitrary"


@dataclass(frozen=True, kw_only=True)
class Conclusions:
    """What a reader needs first."""

    line: str
    """The verdict on the result, as a sentence."""
    word: str | None
    """"fits", "doubtful", "does not fit"; None: an earlier version made the result."""
    reasons: tuple[tuple[str, str], ...]
    """Severity and sentence of each."""
    metric: str
    """Whether lengths are metres, some sentences."""
    metric_word: str
    """"determined", "weakly determined", "not determined", "arbitrary"; where the
    result does not simply fit, "doubtful" or "withheld"."""
    fit: str
    ports: tuple["PortVerdict", ...]
    open: tuple[str, ...]
    """What is not determined or doubtful, and what to do about it."""


@dataclass(frozen=True, kw_only=True)
class PortVerdict:
    """How well the port of one camera is known."""

    camera: str
    text: str
    words: tuple[tuple[str, str], ...]
    """What, and the word for how well the images determine it."""


def verdict_of(summary: dict[str, Any]) -> Conclusions:
    """The verdict of a summary.json."""
    rms = summary["reprojection_rms_px"]
    registered, frames = summary["num_registered_frames"], summary["num_frames"]
    points, count = summary["num_points"], summary["num_observations"]
    return Conclusions(
        line=verdict_line(summary),
        word=summary.get("verdict"),
        reasons=tuple((r["severity"], r["text"]) for r in summary.get("reasons", ())),
        metric=_metric(summary),
        metric_word=summary["scale"]["verdict"],
        fit=f"{registered} of {frames} frames are registered{_images(summary)}, with "
        f"{points} points "
        f"seen in {count} observations. The adjustment brought their true reprojection "
        f"error from {rms['before']:.3g} to {rms['after']:.3g} px RMS.",
        ports=tuple(_port(camera, summary) for camera in summary["cameras"]),
        open=tuple(_sentence(text) for text in summary["warnings"]),
    )


def _images(summary: dict[str, Any]) -> str:
    """How many images that is, where some are missing."""
    total = summary.get("num_images")  # none in results of earlier versions
    if total is None or summary["num_registered_images"] == total:
        return ""
    return f" ({summary['num_registered_images']} of {total} images)"


def small_lengths(summary: dict[str, Any]) -> tuple[str, float]:
    """The unit of small lengths, and how many of it a unit of the model is."""
    return ("units", 1.0) if unit_of(summary) == "units" else ("mm", 1e3)


def unit_of(summary: dict[str, Any]) -> str:
    """Of lengths: "m", or "units" if nothing determines the scale."""
    return "units" if summary["scale"]["unit"] == ARBITRARY_UNIT else "m"


def rounded(value: float, stddev: float | None, scale: float = 1.0) -> str:
    """A number with the digits that its standard deviation leaves it."""
    value = scale * value
    if stddev is None or not stddev > 0.0:
        return f"{value:.6g}"
    return f"{value:.{_decimals(scale * stddev)}f}"


def deviation(stddev: float | None, scale: float = 1.0) -> str:
    """A standard deviation with two digits."""
    if stddev is None:
        return "-"
    if not stddev > 0.0:
        return "0"
    return f"{scale * stddev:.{_decimals(scale * stddev)}f}"


def _decimals(stddev: float) -> int:
    """Decimals that show two digits of a standard deviation."""
    return min(max(1 - math.floor(math.log10(stddev)), 0), 9)


def with_deviations(
    value: float, own: float | None, total: float | None, unit: tuple[str, float]
) -> str:
    """An estimate in a sentence, with its deviation in all and that from the images.

    Args:
        value, own, total: in the unit of the summary.
        unit: what is printed, and how many of it that unit is.
    """
    name, scale = unit
    text = f"{rounded(value, own or total, scale)}"
    if total is not None:
        text += f" ± {deviation(total, scale)}"
    if own is not None:
        text += f" (± {deviation(own, scale)} from the images)"
    return f"{text} {name}"


def tilts_deg(normal: list[float]) -> tuple[float, float]:
    """The normal's slopes against the optical axis, which people can imagine."""
    x, y = (math.degrees(math.asin(value)) for value in normal[:2])
    return x, y


def tilts_of(camera: dict[str, Any]) -> list[tuple[float, float | None, float | None]]:
    """Each slope of a normal with its own deviations, from the images and in all; a
    summary of an earlier version has none."""
    none = [None, None]
    own, total = (
        camera.get(f"tilt_xy_stddev{kind}_deg", none) for kind in ("", "_in_all")
    )
    return list(zip(tilts_deg(camera["normal"]), own, total, strict=True))


def known_length_rows(summary: dict[str, Any]) -> list[tuple[str, ...]]:
    """Given, its standard deviation, found, difference, millimetres; and the latter in
    standard deviations of what was given."""
    rows: list[tuple[str, ...]] = []
    for row in summary.get("known_lengths") or ():
        given, stddev, found = row["given_m"], row["stddev_m"], row["found_m"]
        first, second, miss = (
            rounded(value, stddev, 1e3) for value in (given, found, found - given)
        )
        sigmas = f"{(found - given) / stddev:+.1f}"
        rows.append((first, deviation(stddev, 1e3), second, miss, sigmas))
    return rows


def position_words(summary: dict[str, Any]) -> str | None:
    """What came of positions of the frames; None if none were given."""
    found = summary.get("positions")
    if found is None:
        return None
    wrong = found["outliers"]
    place = ", ".join(
        "-" if value is None else f"{value:.2g}" for value in found["place_stddev_m"]
    )
    text = (
        f"{found['num_positions'] - len(wrong)} of {found['num_positions']} positions "
        f"are used; they miss the model by {found['rms_miss_m']:.3g} m RMS, "
        f"{found['scatter']:.2g} times what their standard deviations say. The model's "
        f"place is known to {place} m, its turn to {found['turn_stddev_deg']:.2g} deg."
    )
    if wrong:
        names = ", ".join(wrong[:10]) + (" ..." if len(wrong) > 10 else "")
        text += f" Left out: {names}."
    return text


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith(('.', '?')) else '.'}"


def _metric(summary: dict[str, Any]) -> str:
    scale = summary["scale"]
    word, stddev = scale["verdict"], scale["relative_stddev"]
    in_all = scale["relative_stddev_in_all"]
    if word == "arbitrary":
        return (
            "The model is not metric: nothing determines its scale, and every length "
            "below is in an arbitrary unit."
        )
    if word == "not determined":
        return "The model is not metric: what was given does not determine its scale."
    if word == WITHHELD:
        return (
            "Whether the model is metric is withheld, because the model does not fit "
            "the images: no length and no ± below can be relied on."
        )
    known = (
        f"every length shares an error of {1e2 * in_all:.2g} % in all, "
        f"{1e2 * stddev:.2g} % from the images"
    )
    kind = "metric" if word == "determined" else "metric, but weakly"
    if word == DOUBTFUL_WORD:
        kind, known = "doubtful", f"if it fits, {known}"
    return f"The model is {kind}: {known}. {_source(summary)}"


def _source(summary: dict[str, Any]) -> str:
    """Where the scale comes from."""
    baseline, stddev = summary["baseline_m"], summary["baseline_stddev_m"]
    sources = []
    if baseline is not None:
        exact = f"± {1e3 * stddev:.2g} mm" if stddev > 0.0 else "held"
        sources.append(f"the baseline of {1e3 * baseline:.5g} mm, {exact}")
    if summary.get("known_lengths"):
        sources.append(f"{len(summary['known_lengths'])} known lengths")
    if summary.get("positions"):
        used = summary["positions"]
        count = used["num_positions"] - len(used["outliers"])
        sources.append(f"{count} positions of frames")
    if not sources:
        return (
            "Its scale comes from refraction alone, with the port taken as given; "
            "errors of the port come on top."
        )
    text = f"Its scale comes from {', and from '.join(sources)}."
    if baseline is not None and stddev == 0.0 and len(sources) == 1:
        text += " One per cent wrong there is one per cent wrong everywhere"
        known = len(summary.get("error_budget", ())) > 1
        text += "; the error budget shows how well it is known." if known else "."
    return text


def _port(camera: dict[str, Any], summary: dict[str, Any]) -> PortVerdict:
    name, small = camera["name"], small_lengths(summary)
    kind = kind_of_word(camera["port"])
    if not kind.refracts:
        return PortVerdict(camera=name, text=kind.noun, words=())
    if kind.has("center"):
        parts = zip(
            camera["center_m"],
            camera["center_stddev_m"],
            camera["center_stddev_in_all_m"],
            strict=True,
        )
        center = ", ".join(with_deviations(v, s, t, small) for v, s, t in parts)
        return PortVerdict(
            camera=name,
            text=f"{kind.noun}, its centre at {center} from the projection centre",
            words=(("centre", camera["center_verdict"]),),
        )
    tilt = " and ".join(
        f"{with_deviations(*known, ('deg', 1.0))} towards {axis}"
        for axis, known in zip("xy", tilts_of(camera), strict=True)
    )
    distance = with_deviations(
        camera["distance_m"],
        camera["distance_stddev_m"],
        camera["distance_stddev_in_all_m"],
        small,
    )
    return PortVerdict(
        camera=name,
        text=f"{kind.noun}, its normal tilted by {tilt}, at {distance} from the "
        "projection centre",
        words=(
            ("tilt", camera["normal_verdict"]),
            ("distance", camera["distance_verdict"]),
        ),
    )
