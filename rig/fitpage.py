"""A fit as one page to read, to print and to quote from: figures, tables, and the text a paper's caption needs."""

import html
import math
import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rig.errors import RunError
from rig.figures import SIMULATED
from rig.files import write_atomically
from rig.fitfigures import ALL_TERMS, bars_mean, draw_fit, model_title, percent, reading_words, reflectances_of, unit_of_coefficients
from rig.fitreadings import Readings, readings_of, tenth

if TYPE_CHECKING:
    from fitting.compare import Comparison, RungResult
    from fitting.fit import Fit
    from fitting.linear import Coefficient
    from rig.fits import StoredFit

MODELS = {
    "lambert": "Lambert's law",
    "phong": "a Lambertian term and a normalised Phong lobe about the mirror direction",
    "ggx": "a Lambertian term and Cook and Torrance's microfacets with GGX slopes",
    "paper": "the mixture of eq. (8), its four distributions those of eqs. (1) to (7) as they stand",
    "radiometric": "the mixture of eq. (8), its terms the lobes of eqs. (1) to (6) over cells and floor as a detector reads them, in 1/sr",
    "interreflecting": "the mixture of eq. (8), its terms as a detector reads them, with light thrown on from dome to dome in all orders",
    "body": "light mirrored by clear domes, and light that was inside them, the pigment and the mesophyll",
}
"""What was fitted, for a caption; equations by their numbers in Tachino, Terado, Kenmochi and Kotani."""

MINIMISED = {
    "relative": "relative weights, \N{GREEK CAPITAL LETTER SIGMA}((I - I_exp)/I_exp)\N{SUPERSCRIPT TWO}",
    "plain": "equal weights, \N{GREEK CAPITAL LETTER SIGMA}(I - I_exp)\N{SUPERSCRIPT TWO}",
    "sigma": "weights by uncertainty, \N{GREEK CAPITAL LETTER SIGMA}((I - I_exp)/\N{GREEK SMALL LETTER SIGMA})\N{SUPERSCRIPT TWO}",
    "covariance": "weights by the readings' full covariance",
}

FIGURES = {
    "polar": "Measured against model in polar form, as in figures 8 and 9 of the paper; the arrow points towards the light",
    "cartesian": "Measured against model by angle; below, residuals (measured less modelled) in percent of the reading, the band being "
    "10 %, and in standard uncertainties where they are known, the band being 2",
    "coefficients": "Coefficients with 95 % intervals, as in figure 7 of the paper",
    "ladder": "The ladder of models: errors fitted and left out, and AICc; grey: within 2 of the least, dashed: E of 10 %",
}

DASH = "\N{EN DASH}"
MINUS = "\N{MINUS SIGN}"
DEGREE = "\N{DEGREE SIGN}"
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

STYLE = """
:root { color-scheme: light }
body { font: 15px/1.45 system-ui, "Helvetica Neue", Arial, sans-serif; color: #111; background: #fff; max-width: 62rem; margin: 2rem auto;
  padding: 0 1rem }
h1 { font-size: 1.6rem; margin: 0 0 .3rem } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; border-bottom: 1px solid #bbb }
.mark { color: #b00000; font-weight: 700; letter-spacing: .06em } .warn { color: #b00000; font-weight: 600 }
.result { font-size: 1.1rem } figure { margin: 1.2rem 0; break-inside: avoid } figure svg { max-width: 100%; height: auto }
figcaption { color: #333; font-size: .9rem } table { border-collapse: collapse; margin: .6rem 0; font-variant-numeric: tabular-nums }
th, td { padding: .18rem .7rem; text-align: right; border-bottom: 1px solid #ddd; vertical-align: top }
td { white-space: nowrap } td.words { white-space: normal; min-width: 6rem }
th { border-bottom: 1px solid #333; background: #f4f4f4 } td:first-child, th:first-child, td.words, th.words { text-align: left }
thead { display: table-header-group } tr { break-inside: avoid } .wide { overflow-x: auto } tr.out td { color: #0a4f86; font-style: italic }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1rem; margin: .6rem 0 } dt { color: #444 }
dd { margin: 0; overflow-wrap: anywhere }
blockquote { margin: .6rem 0; padding: .7rem 1rem; background: #f6f6f6; border-left: 4px solid #555; user-select: all }
@media print { body { font-size: 10pt; max-width: none; margin: 0; padding: 0 } table { font-size: 8.5pt } h2 { break-after: avoid } }
"""
STAMP = "@page { @top-right { content: '%s'; color: #b00000; font: bold 11pt Arial, sans-serif } }"
"""Puts a mark on every printed sheet."""


def write_page(stored: "StoredFit", folder: Path, comparison: "Comparison | None" = None) -> Path:
    """Write `<id>.html` into `folder`, and its figures as PNG and SVG into `figures/<id>/` below; return the page.

    Parameters
    ----------
    stored : StoredFit
    folder : Path
        Made where it is not there.
    comparison : fitting.compare.Comparison, optional
        The ladder of models over the same readings.

    Raises
    ------
    RunError
        Where a file cannot be written.
    """
    page = folder / f"{stored.id}.html"
    try:
        drawn = draw_fit(stored.fit, folder / "figures" / stored.id, label=stored.label, simulated=stored.simulated, comparison=comparison)
        pictures = [path for path in drawn if path.suffix == ".svg"]
        write_atomically(page, _page(stored, pictures, comparison))
    except OSError as exc:
        raise RunError(f"{exc.filename or page}: the fit's page cannot be written: {exc.strerror}") from exc
    return page


def result(stored: "StoredFit") -> str:
    """Return the outcome in one sentence, with whatever stands against it."""
    fit = stored.fit
    size = f"mean E {percent(fit.E_mean)}, at most {percent(fit.E_max)}"
    what = f"Model \u201c{model_title(fit.model)}\u201d: {size}, over {_count(len(fit), 'reading')} of {stored.label}"
    against = []
    if not fit.converged:
        against.append("the search for its shape did NOT converge")
    if fit.at_bounds:
        against.append(f"{_listed(list(fit.at_bounds))} ended at a bound")
    if loose := [name for name in fit.searched if fit.shape_sigma.get(name) is None and name not in fit.at_bounds]:
        against.append(f"the readings do not tell how far {_listed(loose)} can be trusted")
    if loose := list(fit.linear.undetermined):
        against.append(f"{_listed([_plain_symbol(name) for name in loose])} {'is' if len(loose) == 1 else 'are'} NOT determined")
    if any(fit.linear[a].determined and fit.linear[b].determined for a, b, _ in fit.linear.alike):
        against.append("some coefficients are hard to tell apart")
    if misfits(fit):
        against.append("the misfit is larger than the readings' uncertainty, which the intervals leave out")
    return what + (f"; but {_listed(against)}." if against else "; all its coefficients are determined.")


def misfits(fit: "Fit") -> bool:
    """Whether chi-square says that the model does not describe the readings, at three of its standard deviations."""
    chi2, dof = fit.linear.chi2_per_dof, fit.linear.dof
    return chi2 is not None and chi2 > 1 + 3 * math.sqrt(2 / dof)


def caption(stored: "StoredFit") -> str:
    """Return the paragraph that a paper's caption needs, to be pasted: what was fitted to what, how, how well, and what was assumed."""
    fit = stored.fit
    m = fit.measurements
    what, unit = reading_words(fit)
    incidences = [tenth(angle) for angle in m.incidences.tolist()]
    outside = int(np.sum(~m.in_plane))
    low, high = (tenth(angle).replace("-", MINUS) for angle in (np.min(m.theta_r_deg), np.max(m.theta_r_deg)))
    where = f"{outside} of them out of the plane of incidence" if outside else "all in the plane of incidence"
    said = [
        f"{f'{SIMULATED} readings. ' if stored.simulated else ''}Reflected light of {stored.label} "
        f"({what}{f' in {unit}' if unit else ''}), measured (marks) and modelled (lines)",
        f"The model is {MODELS.get(fit.model, model_title(fit.model))}; its coefficients were found by non-negative least squares "
        f"({MINIMISED.get(fit.weights, fit.weights)}) from {_count(len(m), 'reading')} at {_count(len(m.incidences), 'angle')} of "
        f"incidence, {_listed(incidences)}{DEGREE}, and viewing angles from {low} to {high}{DEGREE}, {where}",
    ]
    unit = unit_of_coefficients(fit)
    found = [_quoted(c, unit) for c in fit.linear.coefficients]
    said.append(f"{_listed(found)} (95 % intervals in brackets)")
    if fit.searched:
        said.append("Found with them: " + _listed([_shape_words(fit, name) for name in fit.searched]))
    if math.isfinite(fit.E_mean):
        said.append(f"E of eq. (13) is {percent(fit.E_mean)} on average and {percent(fit.E_max)} at most")
    told = [f"{percent(p.E_mean)} and {percent(p.E_max)} ({p.what})" for p in fit.predicted if p.E_mean is not None]
    if told:
        said.append(f"Fits without them predict these readings (crosses, dashed lines) with E, mean and largest, of {_listed(told)}")
    if fit.shared_with:
        said.append(f"The shape was found jointly with {_listed(fit.shared_with)}")
    held = [name for name in fit.shape if name not in fit.searched]
    assumed = [f"{_shape_meaning(fit.model, name)} {fit.shape[name]:g}" for name in held]
    assumed.append("a detector that sees one point from one direction" if fit.aperture.is_ideal else _aperture_words(fit))
    said.append(f"Assumed: {_listed(assumed)}")
    if bars := bars_mean(fit):
        said.append(f"Error bars: {bars}")
    if not fit.converged:
        said.append("The search for the shape did NOT converge")
    return ". ".join(said) + "."


def _page(stored: "StoredFit", pictures: Sequence[Path], comparison: "Comparison | None") -> str:
    fit = stored.fit
    title = f"Fit of {stored.label}; model: {model_title(fit.model)}"
    readings = readings_of(fit)
    parts = [
        f"<h1>{_e(title)}{f' <span class=mark>{SIMULATED}</span>' if stored.simulated else ''}</h1>",
        f"<p class=result>{_e(result(stored))}</p>",
        "<h2>What was fitted</h2>",
        _fitted(stored),
        "<h2>Measured and modelled</h2>",
        *(_figure(path, stored) for path in pictures if path.stem.startswith(("polar", "cartesian"))),
        "<h2>Coefficients</h2>",
        *(_figure(path, stored) for path in pictures if path.stem == "coefficients"),
        _coefficients(fit),
        "<h2>Shape</h2>",
        _shape(fit),
        "<h2>How well it fits</h2>",
        _quality(fit),
    ]
    if fit.predicted:
        parts += ["<h2>Predictions</h2>", _predictions(fit)]
    if comparison is not None:
        parts += [
            "<h2>The ladder of models</h2>",
            *(_figure(path, stored) for path in pictures if path.stem == "ladder"),
            _ladder(comparison),
        ]
    parts += [
        "<h2>Caption</h2>",
        f"<blockquote>{_e(caption(stored))}</blockquote>",
        "<h2>Errors by angle</h2>",
        _errors(fit, readings),
        "<h2>Where it comes from</h2>",
        _definitions([("fit", stored.id), *((key.replace("_", " "), value) for key, value in stored.provenance.items())]),
    ]
    mark = f"{SIMULATED}: " if stored.simulated else ""
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<meta name="viewport" content="width=device-width">\n'
        f"<title>{_e(mark + title)}</title>\n<style>{STYLE}{STAMP % SIMULATED if stored.simulated else ''}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )


def _fitted(stored: "StoredFit") -> str:
    fit = stored.fit
    m = fit.measurements
    what, unit = reading_words(fit)
    incidences = ", ".join(f"{tenth(theta)} deg ({int(np.sum(m.incidence_of == k))})" for k, theta in enumerate(m.incidences.tolist()))
    return _definitions(
        [
            ("from", stored.provenance.get("run") or stored.provenance.get("file") or m.source),
            ("fitted on", datetime.fromtimestamp(stored.time, UTC).strftime("%Y-%m-%d %H:%M UTC")),
            ("quantity", f"{what}, {unit or 'no unit'}"),
            ("readings", f"{len(m)}, of which {int(np.sum(~m.in_plane))} out of the plane of incidence"),
            ("incidences (readings)", incidences),
            ("viewing angles", f"{np.min(m.theta_r_deg):.4g} to {np.max(m.theta_r_deg):.4g} deg, positive on the light's side"),
            ("uncertainties", "full covariance" if m.covariance is not None else "one for each reading" if m.sigma is not None else "none"),
            ("model", f"{model_title(fit.model)}: {MODELS.get(fit.model, fit.model)}"),
            ("weights", MINIMISED.get(fit.weights, fit.weights)),
            *([("shape shared with", ", ".join(fit.shared_with))] if fit.shared_with else []),
            ("detector", "one point, one direction" if fit.aperture.is_ideal else _aperture_words(fit)),
        ]
    )


def _coefficients(fit: "Fit") -> str:
    unit = unit_of_coefficients(fit)
    scaled = reflectances_of(fit)
    header = ["coefficient", "value", "standard error", "95 % interval", *(["reflectance", "95 % interval"] if scaled else []), "!"]
    rows = []
    for c in fit.linear.coefficients:
        row = [
            _symbol(c.name) + (f" {_e(ALL_TERMS[c.name])}" if c.name in ALL_TERMS else ""),
            _number(c.value) if c.determined else "any within",
            _number(c.standard_error),
            _interval(c.low, c.high),
        ]
        if scaled:
            value, low, high = scaled[c.name]
            row += [_number(value) if c.determined else "any within", _interval(low, high)]
        rows.append([*row, _e(_remark(c))])
    header[-1] = "remark"
    unit_words = f"In {_e(unit)}. " if unit else ""
    noise = "the readings' own uncertainties" if fit.linear.known_noise else "the scatter of the residuals"
    return _table(header, rows, words=("remark",)) + f"<p>{unit_words}Standard errors and intervals from {noise}.</p>"


def _remark(c: "Coefficient") -> str:
    if not c.determined:
        return "NOT determined by these readings"
    if c.active:
        return "held at 0; the upper end is its upper limit"
    return "not told from 0" if c.low == 0 else ""


def _shape(fit: "Fit") -> str:
    rows = []
    for name, value in fit.shape.items():
        found = name in fit.searched
        error = fit.shape_sigma.get(name) if found else None
        how = "found" if found else "held"
        bound = fit.at_bounds.get(name)
        rows.append(
            [
                _e(name),
                _number(value),
                _number(error) if error is not None else DASH,
                how + (f", <span class=warn>at its bound: {_e(bound)}</span>" if bound else ""),
                _e(_shape_meaning(fit.model, name)),
            ]
        )
    table = _table(["number", "value", "standard error", "how", "meaning"], rows, words=("how", "meaning"))
    return (table if rows else "<p>The model has no shape.</p>") + _search(fit)


def _search(fit: "Fit") -> str:
    if fit.search is None:
        return "<p>Nothing was searched for: given the shape, the coefficients follow by linear least squares.</p>"
    lines = "<br>".join(_e(line) for line in fit.search.splitlines())
    return f"<p>{lines}</p>" if fit.converged else f"<p class=warn>NOT converged: {lines}</p>"


def _quality(fit: "Fit") -> str:
    linear = fit.linear
    scale = fit.unit if fit.quantity == "intensity" else "reflectance factor times cos theta_i"
    chi2 = (
        "no uncertainties, no chi-square"
        if linear.chi2_per_dof is None
        else f"{_number(linear.chi2_per_dof)} ({linear.dof} degrees of freedom)"
    )
    pairs = [
        ("E of eq. (13)", f"mean {percent(fit.E_mean)}, maximum {percent(fit.E_max)}"),
        ("cosine-weighted RMSE", "-" if linear.cosine_rmse is None else f"{linear.cosine_rmse:.4g} ({scale})"),
        ("chi-square per degree of freedom", chi2),
        ("scatter of the weighted residuals", "none: no degrees of freedom" if linear.scale is None else f"{linear.scale:.3g}"),
        ("AICc", "-" if fit.aicc is None else f"{fit.aicc:.2f}"),
        ("condition", f"{linear.condition:.4g}; {linear.rank} of {len(linear.coefficients)} coefficients are fixed by the readings"),
    ]
    lines = linear.statement.splitlines()[len(linear.coefficients) :]
    return _definitions(pairs) + "<ul>" + "".join(f"<li>{_e(line)}</li>" for line in lines) + "</ul>"


def _predictions(fit: "Fit") -> str:
    rows = [[_e(p.what), str(p.measured.size), percent(p.E_mean), percent(p.E_max)] for p in fit.predicted]
    return "<p>By fits without these readings.</p>" + _table(["readings", "number", "mean E", "maximum E"], rows)


def _ladder(comparison: "Comparison") -> str:
    rows = []
    for row in comparison.rows:
        name = f"<b>{_e(row.title)}</b>" if row is comparison.supported else _e(row.title)
        cells = [percent(row.E_mean), percent(row.E_max), percent(row.left_out)]
        cells += [DASH if v is None else _number(v) for v in (row.cosine_rmse, row.chi2_per_dof, row.aicc)]
        rows.append([name, str(row.parameters), *cells, _e(_doubt(row))])
    header = [
        "model",
        "parameters",
        "mean E",
        "maximum E",
        "left out, mean E",
        "cosine RMSE",
        "chi\N{SUPERSCRIPT TWO}/dof",
        "AICc",
        "remark",
    ]
    said = "".join(f"<p>{_e(line[:1].upper() + line[1:])}.</p>" for line in comparison.statement.splitlines())
    return said + _table(header, rows, words=("remark",)) + _left_out(comparison)


def _doubt(row: "RungResult") -> str:
    """Say what speaks against a model's fit."""
    if row.fit is None:
        return f"not fitted: {row.problem}"
    told = [] if row.fit.converged else ["its search did NOT converge"]
    told += [f"{name} at its {side} bound" for name, side in row.fit.at_bounds.items()]
    told += [f"{_plain_symbol(name)} NOT determined" for name in row.fit.linear.undetermined]
    return "; ".join(told)


def _left_out(comparison: "Comparison") -> str:
    """Return the errors at each incidence by fits without it, where there is more than one."""
    told = [row for row in comparison.rows if row.left_out_by_incidence]
    if not told:
        return ""
    header = ["left out, mean E", *(f"{tenth(theta_i)} deg" for theta_i, _ in told[0].left_out_by_incidence)]
    rows = [[_e(row.title), *(percent(E) for _, E in row.left_out_by_incidence)] for row in told]
    return _table(header, rows)


def _errors(fit: "Fit", readings: Readings) -> str:
    what, unit = reading_words(fit)
    known = readings.sigma > 0
    in_sigma = np.divide(readings.residual, readings.sigma, out=np.full(known.size, math.nan), where=known)
    columns: dict[str, list[str]] = {
        "line": [str(row) if row else DASH for row in readings.row.tolist()],
        "theta_i, deg": [_fixed(angle, ".2f") for angle in readings.theta_i_deg],
        "theta_r, deg": [_fixed(angle, ".2f") for angle in readings.theta_r_deg],
    }
    if np.any(readings.phi_deg != 0):
        columns["phi, deg"] = [_fixed(angle, ".2f") for angle in readings.phi_deg]
    columns[f"{what}{f', {unit}' if unit else ''}"] = [_number(value) for value in readings.value]
    if known.any():
        columns["sigma"] = [_number(sigma) for sigma in readings.sigma]
    columns["model"] = [_number(value) for value in readings.modelled]
    columns["residual, %"] = [_fixed(value, "+.1f") for value in readings.percent]
    if known.any():
        columns["residual/sigma"] = [_fixed(value, "+.1f") for value in in_sigma]
    columns["E, %"] = [_fixed(value, ".2f") for value in readings.E]
    if fit.predicted:
        columns["predicted: E, %"] = [_fixed(value, ".2f") for value in readings.E_foretold]
    if not np.all(readings.fitted):
        columns["fitted"] = ["yes" if fitted else "no" for fitted in readings.fitted]
    kinds = ["" if fitted else "out" for fitted in readings.fitted]
    return _table(list(columns), zip(*columns.values(), strict=True), kinds, words=("fitted",))


def _figure(svg: Path, stored: "StoredFit") -> str:
    kind = re.sub(r"-\d+$", "", svg.stem)
    text = f"{SIMULATED}. {FIGURES[kind]}" if stored.simulated else FIGURES[kind]
    if kind in ("polar", "cartesian") and stored.fit.predicted:
        text += ". Filled marks: readings that were fitted; open: not fitted; crosses, dashed: what fits without these readings predict"
    if kind == "cartesian" and (bars := bars_mean(stored.fit)):
        text += f". Error bars: {bars}"
    return f"<figure>{_inline(svg, text)}<figcaption>{_e(text)}.</figcaption></figure>"


def _inline(svg: Path, text: str) -> str:
    """Return a drawing as part of a page: its names its own, nothing of it pointing outside."""
    drawing = svg.read_text(encoding="utf-8")
    drawing = re.sub(r"<metadata>.*?</metadata>", "", drawing[drawing.index("<svg") :], flags=re.DOTALL)
    own = f"{svg.stem}-"
    drawing = re.sub(r'\bid="', f'id="{own}', drawing)
    drawing = re.sub(r'href="#', f'href="#{own}', drawing)
    drawing = re.sub(r"url\(#", f"url(#{own}", drawing)
    return drawing.replace("<svg ", f'<svg role="img" aria-label="{_e(text)}" ', 1).strip()


def _table(header: Sequence[str], rows: Iterable[Sequence[str]], kinds: Iterable[str] | None = None, *, words: Sequence[str] = ()) -> str:
    """Return a table; cells are HTML already, the header is text; columns of `words` are set left."""
    left = [' class="words"' if name in words else "" for name in header]
    head = "".join(f"<th{c}>{_e(name)}</th>" for name, c in zip(header, left, strict=True))
    rows = list(rows)
    body = "".join(
        f"<tr{f' class={kind}' if kind else ''}>" + "".join(f"<td{c}>{cell}</td>" for cell, c in zip(row, left, strict=True)) + "</tr>\n"
        for row, kind in zip(rows, kinds or [""] * len(rows), strict=True)
    )
    return f"<div class=wide><table><thead><tr>{head}</tr></thead><tbody>\n{body}</tbody></table></div>"


def _definitions(pairs: Iterable[tuple[str, Any]]) -> str:
    return "<dl>" + "".join(f"<dt>{_e(name)}</dt><dd>{_e(str(value))}</dd>" for name, value in pairs) + "</dl>"


def _e(text: str) -> str:
    return html.escape(text)


def _symbol(name: str) -> str:
    return f"<i>x</i><sub>{_e(name.replace('_', ','))}</sub>"


def _plain_symbol(name: str) -> str:
    return f"x_{name}"


def _number(value: float) -> str:
    """Return four digits, a power of ten where there would be many noughts, and a dash for what is not a number."""
    if not math.isfinite(value):
        return "\N{INFINITY}" if value > 0 else DASH
    text = f"{value:.4g}"
    if "e" not in text:
        return text.replace("-", MINUS)
    digits, power = text.split("e")
    raised = str(int(power)).translate(RAISED)
    return f"{digits} \N{MULTIPLICATION SIGN} 10{raised}".replace("-", MINUS)


def _fixed(value: float, form: str) -> str:
    return format(value, form).replace("-", MINUS) if math.isfinite(value) else DASH


def _interval(low: float, high: float) -> str:
    return f"{_number(low)} and more" if math.isinf(high) else f"{_number(low)} to {_number(high)}"


def _quoted(c: "Coefficient", unit: str) -> str:
    unit = f" {unit}" if unit else ""
    if not c.determined:
        return f"{_plain_symbol(c.name)} is not determined ({_interval(c.low, c.high)}{unit})"
    value = f"{_plain_symbol(c.name)} = {_number(c.value)}{unit}"
    return f"{value} (below {_number(c.high)})" if c.value == 0 else f"{value} ({_interval(c.low, c.high)})"


def _shape_words(fit: "Fit", name: str) -> str:
    error = fit.shape_sigma.get(name)
    bound = ", at its bound" if name in fit.at_bounds else ""
    spread = f" \N{PLUS-MINUS SIGN} {_number(error)}" if error is not None else "" if bound else " (without standard error)"
    return f"{_shape_meaning(fit.model, name)} {name} = {_number(fit.shape[name])}{spread}{bound}"


def _shape_meaning(model: str, name: str) -> str:
    from fitting.ladder import RUNGS

    numbers = {number.name: number.meaning for number in RUNGS[model].shape} if model in RUNGS else {}
    return numbers.get(name, name)


def _aperture_words(fit: "Fit") -> str:
    a = fit.aperture
    words = {
        f"an acceptance cone of half-angle {a.acceptance_deg:g} deg": a.acceptance_deg,
        f"a beam of half-angle {a.beam_deg:g} deg": a.beam_deg,
        f"a spot of {a.spot_mm:g} mm": a.spot_mm,
        f"the lamp at {a.lamp_mm} mm": a.lamp_mm,
        f"the detector at {a.detector_mm} mm": a.detector_mm,
        "all of the lit spot in view": a.sees == "spot",
    }
    return _listed([text for text, there in words.items() if there])


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _listed(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
