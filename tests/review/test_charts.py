"""Plots and tables: what is far off does not flatten the rest, every strip is named, colours can be told apart."""

from __future__ import annotations

import itertools
import math
import re

import numpy as np
import numpy.typing as npt
import pytest

from edge_agent.messages import S
from edge_agent.review import charts
from edge_agent.review.charts import LANE, H, Lane, Plot, Scale, W, spread, table, ticks, time_scale

F64 = npt.NDArray[np.float64]
T0 = 1_780_300_800 * S


def test_a_single_wrong_value_does_not_set_the_scale_and_a_real_extreme_does() -> None:
    rng = np.random.default_rng(1)
    quiet = rng.standard_normal(2000)
    low, high = spread(np.append(quiet, 300.0))
    assert -5 < low < -2.5
    assert 2.5 < high < 5
    truck = quiet.copy()
    truck[900:940] -= 6.0  # 2 % of the time, three times as far as all else
    low, high = spread(truck)
    assert low < truck.min()
    assert high > truck.max()
    assert spread(np.array([math.nan])) == (-1.0, 1.0)
    low, high = spread(np.full(50, 7.0))
    assert low < 7.0 < high


def test_what_is_out_of_view_is_counted_marked_and_within_reach() -> None:
    plot = Plot(Scale(0.0, 100.0, "s"), Scale(-10.0, 10.0, "mm"))
    x = np.arange(100.0)
    y = np.zeros(100)
    y[[20, 30]], y[40] = (300.0, 50.0), -77.0
    plot.bars(x, y, y, "#123456", "raw")
    plot.line(x, np.full(100, 12.0), "#000000", "drift")
    html = plot.html("t")
    assert "\u25b2 2 of raw to 300, drift to 12 mm" in html
    assert "\u25bc 1 of raw to \u221277 mm" in html
    (low, high) = (float(v) for v in re.findall(r'data-whole="([^,]*),([^"]*)"', html)[0])
    assert low < -77.0
    assert high > 300.0
    marks = re.findall(r'<path d="([^"]*)"[^>]*class="v edge"', html)
    assert sorted(re.findall(r"M(\d+) ", "".join(marks))) == ["2000", "3000", "4000"]
    assert 'data-do="every"' in html
    drawn = re.findall(r'<path d="([^"]*)"[^>]*class="v dot"', html)[0]
    heights = np.cumsum([int(v) for v in re.findall(r"[Mm]-?\d+ (-?\d+)", drawn)])
    assert heights.min() == -14.5 * H  # drawn where they are, not cut off at the edge
    inside = Plot(Scale(0.0, 100.0, "s"), Scale(-10.0, 10.0, "mm"))
    inside.bars(x, np.zeros(100), np.zeros(100), "#123456", "raw")
    html = inside.html("t")
    assert 'class="off' not in html
    assert 'data-do="every"' not in html
    assert 'data-whole="-10.0,10.0"' in html


def test_a_plot_says_in_words_what_it_shows() -> None:
    plot = Plot(time_scale(T0, T0 + 60 * S), Scale(-10.0, 10.0, "mm"))
    t = T0 + np.arange(61) * S
    y = np.sin(np.arange(61.0)) * 4
    plot.area(t, y - 9.0, y + 9.0, 2.0 * S, "#000000", "band", 0.2)
    plot.area(t, y, y, 2.0 * S, "#000000", 'fused "live" <b>')
    spoken = re.findall(r'role="img" aria-label="([^"]*)"', plot.html("deck x"))[0]
    assert spoken.startswith("deck x, 2026-06-01 08:00:00 to 2026-06-01 08:01:00 UTC")
    assert "fused &quot;live&quot; &lt;b&gt; \u22124 to 4 mm" in spoken
    assert "band" not in spoken
    log = Plot(Scale(-1.0, 2.0, "frequency [Hz]", log=True), Scale(-3.0, 3.0, "mm\u00b2/Hz", log=True))
    log.line(np.array([-1.0, 2.0]), np.array([-2.0, 1.0]), "#000000", "fused")
    assert "frequency [Hz] 0.1 to 100; fused 0.01 to 10 mm\u00b2/Hz" in log.html("s")


def test_every_lane_has_its_name_its_place_and_boxes_that_are_seen() -> None:
    plot = Plot(time_scale(T0, T0 + 100 * S), Scale(0, 1, ""))
    many = [(float(T0 + k * S // 5), float(T0 + k * S // 5 + S // 100), "") for k in range(400)]
    now = float(T0 + 50 * S)
    plot.lanes(
        [Lane("jump open, deck", "once", "#D55E00", [(now, now, "a <b>")]), Lane("lost", "400", "#0072B2", many)]
    )
    html = plot.html("events", values=False)
    assert plot.height == 2 * LANE
    labels = re.findall(r'<span style="top:([\d.]+)%"><i style="--c:(#\w+)"></i>([^<]*) <small>([^<]*)<', html)
    assert labels == [("0.00", "#D55E00", "jump open, deck", "once"), ("50.00", "#0072B2", "lost", "400")]
    (x, y, w, h) = map(int, re.findall(r'<rect x="(\d+)" y="(\d+)" width="(\d+)" height="(\d+)"', html)[0])
    assert x == W // 2
    assert w >= 1  # a box of no width is not drawn at all
    assert 0 < y < y + h <= H / 2
    path = re.findall(r'<path d="(M[^"]*)" fill="#0072B2"', html)[0]
    assert path.count("z") == 400
    assert all(v >= H / 2 for v in map(int, re.findall(r"M\d+ (\d+)", path)))
    assert "jump open, deck once" in html
    assert "a &lt;b&gt;" in html


def test_boxes_that_touch_are_drawn_as_one() -> None:
    plot = Plot(time_scale(T0, T0 + 1000 * S), Scale(0, 1, ""))
    plot.lanes(
        [Lane("lost", "", "#0072B2", [(float(T0 + k * S // 100), float(T0 + k * S // 100), "") for k in range(9000)])]
    )
    assert len(plot.layers) == 1
    assert plot.layers[0].count("z") == 1


@pytest.mark.parametrize("columns", [3, 6])
def test_a_wide_table_carries_its_head_in_every_cell(columns: int) -> None:
    head = [f"c<small>{k}</small>" for k in range(columns)]
    html = table(head, [[f"v{k}" for k in range(columns)], [""] * columns], 1)
    cells = re.findall(r"<td([^>]*)>(.*?)</td>", html)
    assert len(cells) == 2 * columns
    if columns < charts.STACKED:
        assert not any("data-h" in a for a, _ in cells)
    else:
        assert [re.findall(r'data-h="([^"]*)"', a)[0].split() for a, _ in cells[:columns]] == [
            ["c", str(k)] for k in range(columns)
        ]
        assert cells[0][1] == "<div>v0</div>"
        assert cells[columns][1] == ""  # nothing to show on a phone
    assert "<thead>" in html


def test_a_long_table_may_be_split_between_pages() -> None:
    assert "long" not in table(["a"], [["x"]] * 12)
    assert "long" in table(["a"], [["x"]] * 13)


def test_large_numbers_are_short() -> None:
    assert [t for _, t in ticks(Scale(0.0, 6.1e8, ""), 5)] == ["0", "2e8", "4e8", "6e8"]


# ------------------------------------------------------------------------------------------------------------- colours


def _linear(colour: str) -> F64:
    c = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def _lab(linear: F64) -> F64:
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x = to_xyz @ np.clip(linear, 0, 1) / np.array([0.9505, 1.0, 1.089])
    f = np.where(x > 0.008856, np.cbrt(x), 7.787 * x + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


BLIND = {  # Machado, Oliveira & Fernandes (2009), severity 1
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritan": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
COLOURS = (charts.BLUE, charts.GREY, charts.RED, charts.ORANGE, charts.GREEN, charts.PURPLE, charts.DARK, charts.INK)


def test_colours_stand_out_of_the_paper() -> None:
    for colour in (*COLOURS, charts.RAW, *charts.MODE_COLOURS.values(), *charts.QUALITY_COLOURS.values()):
        luminance = float(np.array([0.2126, 0.7152, 0.0722]) @ _linear(colour))
        assert 1.05 / (luminance + 0.05) >= 3.0, colour  # WCAG 2.1, 1.4.11


@pytest.mark.parametrize(
    "together",
    [
        (charts.BLUE, charts.ORANGE, charts.GREEN),  # axes
        (charts.RAW, charts.BLUE, charts.RED),  # raw, live, smoothed
        (charts.INK, charts.ORANGE, charts.GREEN, charts.BLUE),  # split
        (charts.BLUE, charts.ORANGE, charts.GREY),  # singular values
    ],
)
@pytest.mark.parametrize("eyes", [None, *BLIND])
def test_curves_of_one_plot_are_told_apart_by_the_colour_blind(together: tuple[str, ...], eyes: str | None) -> None:
    seen = [_lab(np.array(BLIND[eyes]) @ _linear(c) if eyes else _linear(c)) for c in together]
    for a, b in itertools.combinations(seen, 2):
        assert np.linalg.norm(a - b) > 15.0  # a just noticeable difference is about 2


def test_text_is_legible() -> None:
    from importlib.resources import files

    css = files("edge_agent.review").joinpath("page.css").read_text(encoding="utf-8")
    for name in ("ink", "soft", "accent"):
        colour = re.findall(rf"--{name}:(#\w{{6}})", css)[0]
        luminance = float(np.array([0.2126, 0.7152, 0.0722]) @ _linear(colour))
        assert 1.05 / (luminance + 0.05) >= 4.5, name  # WCAG 2.1, 1.4.3
