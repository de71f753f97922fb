"use strict";
(function () {
  const W = 10000, H = 4000, charts = [];
  const steps = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200, 86400];
  const minus = s => String(s).replace("-", "\u2212");
  const two = n => String(n).padStart(2, "0");
  function numbers(lo, hi, about) {
    let s = Math.pow(10, Math.floor(Math.log10((hi - lo) / about)));
    s = [s, 2 * s, 5 * s, 10 * s].find(v => (hi - lo) / v <= about);
    const digits = Math.max(0, -Math.floor(Math.log10(s) + 1e-9)), out = [];
    for (let k = Math.ceil(lo / s - 1e-9); k <= Math.floor(hi / s + 1e-9); k++) out.push([k * s, k ? minus(Math.abs(k * s) < 1e6 ? (k * s).toFixed(digits) : (+(k * s).toPrecision(3)).toExponential().replace("e+", "e")) : "0"]);
    return out;
  }
  function powers(lo, hi) {
    const out = [], wide = hi - lo;
    if (wide < 0.7) return numbers(Math.pow(10, lo), Math.pow(10, hi), 5).filter(t => t[0] > 0).map(t => [Math.log10(t[0]), t[1]]);
    const every = Math.max(1, Math.ceil(wide / 8));
    for (let k = Math.floor(lo); k <= hi; k++)
      for (const m of wide < 3 ? [1, 2, 5] : [1]) {
        const at = k + Math.log10(m), v = m * Math.pow(10, k);
        if (at >= lo && at <= hi && k % every === 0) out.push([at, Math.abs(k) > 3 && m === 1 ? "10<sup>" + minus(k) + "</sup>" : String(+v.toPrecision(3))]);
      }
    return out;
  }
  function times(lo, hi, about) {
    const seconds = (hi - lo) / 1000, out = [];
    let s = steps.find(v => seconds / v <= about);
    if (!s) s = 86400 * Math.ceil(seconds / 86400 / about);
    for (let k = Math.ceil(lo / 1000 / s); k * s * 1000 <= hi; k++) {
      const t = new Date(Math.round(k * s * 1000)), hm = two(t.getUTCHours()) + ":" + two(t.getUTCMinutes());
      const date = two(t.getUTCMonth() + 1) + "-" + two(t.getUTCDate());
      let text = hm;
      if (s < 1) text = hm + ":" + two(t.getUTCSeconds()) + "." + String(t.getUTCMilliseconds()).padStart(3, "0").slice(0, s < 0.01 ? 3 : s < 0.1 ? 2 : 1);
      else if (s < 60) text = hm + ":" + two(t.getUTCSeconds());
      else if (s >= 86400) text = date;
      else if (seconds >= 86400) text = date + " " + hm;
      out.push([k * s * 1000, text]);
    }
    return out;
  }
  function draw(c) {
    const [u0, u1, v0, v1] = c.view;
    c.svg.setAttribute("viewBox", [u0, v0, u1 - u0, v1 - v0].join(" "));
    c.svg.classList.toggle("far", v0 !== 0 || v1 !== H);  // what stands at the edges belongs to the first view
    const x = u => c.x[0] + (c.x[1] - c.x[0]) * u / W, y = v => c.y[0] + (c.y[1] - c.y[0]) * (H - v) / H;
    const few = c.small || c.plot.clientWidth < 420 ? 4 : 7;  // on paper those side by side are narrow
    const xs = c.kind === "log" ? powers(x(u0), x(u1)) : c.kind === "lin" ? numbers(x(u0), x(u1), few) : times(x(u0), x(u1), few);
    const ys = !c.values ? [] : c.ylog ? powers(y(v1), y(v0)) : numbers(y(v1), y(v0), 5);
    let grid = "", tx = "", ty = "";
    for (const [at, text] of xs) {
      const share = (at - x(u0)) / (x(u1) - x(u0));
      grid += "<path d=\"M" + (u0 + share * (u1 - u0)) + " " + v0 + "V" + v1 + "\"/>";
      tx += "<span" + (share > 0.96 ? " class=e" : "") + " style=\"left:" + 100 * share + "%\">" + text + "</span>";
    }
    for (const [at, text] of ys) {
      const share = (at - y(v1)) / (y(v0) - y(v1));
      grid += "<path d=\"M" + u0 + " " + (v1 - share * (v1 - v0)) + "H" + u1 + "\"/>";
      ty += "<span style=\"top:" + 100 * (1 - share) + "%\">" + text + "</span>";
    }
    c.grid.innerHTML = grid; c.xt.innerHTML = tx; c.yt.innerHTML = ty;
  }
  // plots over the whole period move together
  function look(c, u0, u1, v0, v1) {
    const wide = Math.min(Math.max(u1 - u0, W / 5000), W), high = Math.min(Math.max(v1 - v0, H / 500), c.bottom - c.top);
    u0 = Math.min(Math.max(u0, 0), W - wide); v0 = Math.min(Math.max(v0, c.top), c.bottom - high);
    for (const o of c.kind === "time" ? charts.filter(o => o.kind === "time") : [c]) {
      o.view[0] = u0; o.view[1] = u0 + wide;
      if (o === c) { o.view[2] = v0; o.view[3] = v0 + high; }
      draw(o);
    }
  }
  // by a factor about a place of the plot; values go beyond the first view where time cannot go further out
  function zoom(c, by, x) {
    const [u0, u1, v0, v1] = c.view, at = u0 + x * (u1 - u0);
    if (by > 1 && u1 - u0 >= W - 1e-6) {
      const m = (v0 + v1) / 2, half = by * (v1 - v0) / 2;
      look(c, 0, W, Math.min(m - half, 0), Math.max(m + half, H));
    } else look(c, at - by * (at - u0), at + by * (u1 - at), v0, v1);
  }
  function act(c, what) {
    const [u0, u1, v0, v1] = c.view, w = u1 - u0;
    if (what === "in") zoom(c, 0.5, 0.5);
    if (what === "out") zoom(c, 2, 0.5);
    if (what === "left") look(c, u0 - w / 2, u1 - w / 2, v0, v1);
    if (what === "right") look(c, u0 + w / 2, u1 + w / 2, v0, v1);
    if (what === "every") look(c, u0, u1, c.top, c.bottom);
    if (what === "all") look(c, 0, W, 0, H);
  }
  const keys = { "+": "in", "=": "in", "-": "out", ArrowLeft: "left", ArrowRight: "right", "0": "all", Escape: "all", "*": "every" };
  function hint(c) {
    if (c.hint) return;
    c.hint = document.createElement("div"); c.hint.className = "hint"; c.hint.textContent = "Ctrl + wheel zooms, or click first";
    c.plot.appendChild(c.hint);
    setTimeout(() => { c.hint.remove(); c.hint = null; }, 1500);
  }
  for (const f of document.querySelectorAll(".chart")) {
    const plot = f.querySelector(".plot"), d = f.dataset;
    const c = { plot, svg: plot.querySelector("svg"), grid: plot.querySelector(".grid"), xt: plot.querySelector(".xt"), yt: plot.querySelector(".yt"),
      small: !!f.closest(".grid3"), kind: d.kind, x: d.x.split(",").map(Number), y: d.y.split(",").map(Number), ylog: d.ylog === "1", values: d.values === "1", view: [0, W, 0, H] };
    const [low, high] = d.whole.split(",").map(Number), size = c.y[1] - c.y[0];
    c.top = Math.min(0, H * (c.y[1] - high) / size); c.bottom = Math.max(H, H + H * (c.y[0] - low) / size);
    charts.push(c);
    f.querySelectorAll("button").forEach(b => b.addEventListener("click", () => act(c, b.dataset.do)));
    plot.addEventListener("dblclick", () => act(c, "all"));
    plot.addEventListener("keydown", e => {
      if (!keys[e.key] || e.ctrlKey || e.metaKey || e.altKey) return;
      act(c, keys[e.key]); e.preventDefault();
    });
    // the wheel belongs to the page until it is asked for
    plot.addEventListener("wheel", e => {
      if (!e.ctrlKey && !e.metaKey && !e.shiftKey && !plot.classList.contains("held")) { hint(c); return; }
      e.preventDefault();
      const r = plot.getBoundingClientRect(), turned = e.deltaY || e.deltaX;
      zoom(c, Math.pow(1.0015, Math.max(-400, Math.min(400, turned))), (e.clientX - r.left) / r.width);
    }, { passive: false });
    plot.addEventListener("pointerleave", () => plot.classList.remove("held"));
    plot.addEventListener("blur", () => plot.classList.remove("held"));
    let from = null, box = null;
    plot.addEventListener("pointerdown", e => {
      if (e.button !== 0 || e.pointerType === "touch") return;
      from = [e.clientX, e.clientY];
      plot.classList.add("held");
      plot.setPointerCapture(e.pointerId);
    });
    plot.addEventListener("pointermove", e => {
      if (!from) return;
      const r = plot.getBoundingClientRect(), tall = c.values && Math.abs(e.clientY - from[1]) > 24;
      if (!box) { box = document.createElement("div"); box.className = "pick"; plot.appendChild(box); }
      box.style.left = Math.min(from[0], e.clientX) - r.left + "px"; box.style.width = Math.abs(e.clientX - from[0]) + "px";
      box.style.top = (tall ? Math.min(from[1], e.clientY) - r.top : 0) + "px";
      box.style.height = (tall ? Math.abs(e.clientY - from[1]) : r.height) + "px";
    });
    const end = e => {
      if (!from) return;
      const r = plot.getBoundingClientRect(), [u0, u1, v0, v1] = c.view;
      const a = Math.min(from[0], e.clientX) - r.left, b = Math.max(from[0], e.clientX) - r.left;
      const p = Math.min(from[1], e.clientY) - r.top, q = Math.max(from[1], e.clientY) - r.top;
      if (box) { box.remove(); box = null; }
      from = null;
      if (e.type === "pointerup" && b - a > 6) {
        const tall = c.values && q - p > 24, kx = (u1 - u0) / r.width, ky = (v1 - v0) / r.height;
        look(c, u0 + a * kx, u0 + b * kx, tall ? v0 + p * ky : v0, tall ? v0 + q * ky : v1);
      }
    };
    plot.addEventListener("pointerup", end);
    plot.addEventListener("pointercancel", end);
    // fingers: two pinch and move, one moves sideways, a double tap goes back; up and down scrolls the page
    let held = null, tapped = 0;
    const fingers = e => {
      const r = plot.getBoundingClientRect(), xs = [...e.touches].map(t => (t.clientX - r.left) / r.width);
      return xs.length > 1 ? [(xs[0] + xs[1]) / 2, Math.max(Math.abs(xs[0] - xs[1]), 0.02), 2] : [xs[0], 1, 1];
    };
    const hold = e => { held = e.touches.length ? { at: fingers(e), view: c.view.slice(), moved: false } : null; };
    plot.addEventListener("touchstart", hold, { passive: true });
    plot.addEventListener("touchmove", e => {
      const now = fingers(e);
      if (!held || held.at[2] !== now[2]) { hold(e); return; }
      const [u0, u1, v0, v1] = held.view, w = u1 - u0, wide = w * held.at[1] / now[1];
      if (now[2] === 1 && w >= W - 1e-6) return;
      if (now[2] === 2 && e.cancelable) e.preventDefault();
      const begin = u0 + held.at[0] * w - now[0] * wide;
      held.moved = true;
      look(c, begin, begin + wide, v0, v1);
    }, { passive: false });
    plot.addEventListener("touchend", e => {
      const still = held && !held.moved && held.at[2] === 1;
      hold(e);
      if (!still) return;
      if (e.timeStamp - tapped < 350) { act(c, "all"); tapped = 0; } else tapped = e.timeStamp;
    });
  }
})();
