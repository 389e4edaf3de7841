// The tables below the scene: points, photographs, image points, rejected and unused ones, scale bars.

import { range } from "./data.js"
import { make } from "./page.js"
import { fixed, significant, toPrecision } from "./numbers.js"
import { Table } from "./tables.js"

export function tablesOf(model, hub, element) {
  const { unit, fine } = model
  const a = model.a
  const short = (value) => (Number.isFinite(value) ? significant(value) : "")
  const orFixed = (sigma) => (sigma === 0 ? "fixed" : short(sigma))
  const number = (key, name, of, words, u = "") => ({ key, name, unit: u, value: of, words: (k) => words(of(k), k) })
  const text = (key, name, value) => ({ key, name, value })
  const made = []
  const add = (what, columns, rows, found, kind) => {
    if (rows.length) made.push({ what, kind, table: new Table(what, columns, rows, found, hub) })
  }
  const every = (count) => range(0, count)
  add(
    "points",
    [
      text("name", "point", (j) => model.points[j]),
      ...[0, 1, 2].map((c) => number("XYZ"[c], "XYZ"[c], (j) => model.xyz(j)[c], (v, j) => toPrecision(v, model.sigmas(j)[c]), unit)),
      ...[0, 1, 2].map((c) => number(`s${"XYZ"[c]}`, `s${"XYZ"[c]}`, (j) => model.sigmas(j)[c] * fine.factor, orFixed, fine.unit)),
      number("sigma", "sigma", (j) => model.sigma(j) * fine.factor, orFixed, fine.unit),
      number("rays", "rays", (j) => a["point.rays"][j], String),
      number("angle", "angle", (j) => a["point.angle"][j], (v) => (Number.isFinite(v) ? v.toFixed(1) : ""), "deg"),
      ...(model.hasResiduals ? [number("rms", "RMS", (j) => a["point.rms"][j], short, "px")] : []),
      ...(a["point.displacement"]
        ? [
            number("displacement", "displacement", (j) => model.displacement(j) * fine.factor, short, fine.unit),
            text("state", "", (j) => model.states[a["point.state"][j]]),
          ]
        : []),
      ...(a["point.deviation"] ? [number("deviation", "deviation", (j) => a["point.deviation"][j] * fine.factor, short, fine.unit)] : []),
    ],
    every(model.pointCount),
    (j) => ({ kind: "point", index: j }),
    "point",
  )
  add(
    "photographs",
    [
      text("name", "photograph", (i) => model.photographs[i]),
      text("camera", "camera", (i) => model.camera(i).name),
      ...[0, 1, 2].map((c) => number(`${"XYZ"[c]}0`, `${"XYZ"[c]}0`, (i) => model.centre(i)[c], (v, i) => toPrecision(v, a["photo.sigma"][6 * i + c]), unit)),
      ...["omega", "phi", "kappa"].map((name, c) => number(name, name, (i) => a["photo.angles"][3 * i + c], (v, i) => toPrecision(v, a["photo.sigma"][6 * i + 3 + c]), "deg")),
      number("points", "points", (i) => a["photo.points"][i], String),
      number("rejected", "rejected", (i) => model.raysOfPhoto(i).reduce((n, k) => n + model.a["ray.rejected"][k], 0), String),
      ...(model.hasResiduals ? [number("rms", "RMS", (i) => a["photo.rms"][i], short, "px")] : []),
    ],
    every(model.photoCount),
    (i) => ({ kind: "photograph", index: i }),
    "photograph",
  )
  const ofRay = [
    text("point", "point", (k) => model.points[a["ray.point"][k]]),
    text("photograph", "photograph", (k) => model.photographs[a["ray.photo"][k]]),
    ...[0, 1].map((c) => number("xy"[c], "xy"[c], (k) => model.pair("ray.xy", k)[c], (v) => fixed(v, 2), "px")),
    ...[0, 1].map((c) => number(`v${"xy"[c]}`, `v${"xy"[c]}`, (k) => model.pair("ray.v", k)[c], (v) => fixed(v, 3), "px")),
    number("v", "|v|", (k) => model.residual(k), (v) => fixed(v, 3), "px"),
    number("w", "largest |w|", (k) => model.worstW(k), (v) => (Number.isFinite(v) ? v.toFixed(2) : "")),
  ]
  const fresh = () => ofRay.map((column) => ({ ...column }))
  const pointOf = (k) => ({ kind: "point", index: a["ray.point"][k], ray: k })
  add("image points", fresh(), every(model.rayCount), pointOf, "ray")
  add("rejected image points", fresh(), every(model.rayCount).filter((k) => model.rejected(k)), pointOf, "ray")
  add(
    "detected but not used",
    [
      text("photograph", "photograph", (k) => model.photographs[a["mark.photo"][k]]),
      text("reason", "reason", (k) => model.reasons[a["mark.reason"][k]]),
      ...[0, 1].map((c) => number("xy"[c], "xy"[c], (k) => model.pair("mark.xy", k)[c], (v) => fixed(v, 1), "px")),
    ],
    every(a["mark.photo"].length).sort((k, l) => a["mark.reason"][k] - a["mark.reason"][l] || k - l),
    (k) => ({ kind: "photograph", index: a["mark.photo"][k] }),
    "mark",
  )
  add(
    "scale bars",
    [
      text("name", "scale bar", (b) => `${model.points[model.bars[b].from]} - ${model.points[model.bars[b].to]}`),
      number("length", "length", (b) => model.bars[b].length ?? NaN, (v) => significant(v, 9), unit),
      number("difference", "adjusted minus given", (b) => (model.bars[b].difference ?? NaN) * fine.factor, short, fine.unit),
      number("sigma", "given sigma", (b) => (model.bars[b].sigma ?? NaN) * fine.factor, short, fine.unit),
    ],
    every(model.bars.length),
    (b) => ({ kind: "point", index: model.bars[b].from }),
    "bar",
  )
  tabs(made, element)
  hub.on("select", (found) => {
    if (!found) return
    for (const { kind, table } of made) if (kind === found.kind && table.active !== found.index) table.reveal(found.index)
  })
}

/** Tabs that show one table at a time (WAI-ARIA Authoring Practices, tabs). */
function tabs(made, element) {
  const list = make("div", { role: "tablist", className: "v-tabs", "aria-label": "tables" })
  const show = (chosen, focus) => {
    made.forEach((one, k) => {
      one.tab.setAttribute("aria-selected", String(k === chosen))
      one.tab.tabIndex = k === chosen ? 0 : -1
      one.table.element.hidden = k !== chosen
    })
    made[chosen].table.draw()
    if (focus) made[chosen].tab.focus()
  }
  made.forEach((one, k) => {
    one.tab = make("button", { type: "button", role: "tab", onclick: () => show(k) }, `${one.what} (${one.table.all.length})`)
    one.tab.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key]
      if (step) show((k + step + made.length) % made.length, true)
    })
    one.table.element.setAttribute("role", "tabpanel")
    list.append(one.tab)
  })
  element.replaceChildren(list, ...made.map((one) => one.table.element))
  show(0)
}
