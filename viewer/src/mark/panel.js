// Beside the photographs: the chosen point with the pictures of its fits, all points, the adjustment and the scale bars.

import { button, facts, make } from "../page.js"
import { counted, fixed, signed, significant, toPrecision } from "../numbers.js"
import { Table } from "../tables.js"

const SIGMA_DIGITS = 2

export class Panel {
  /** @param actions of {choose, open, rename, control, remove, bar, removeBar, accept, refuse}. */
  constructor(model, element, hub, actions) {
    Object.assign(this, { model, actions })
    this.point = make("section", { className: "m-card", "aria-label": "chosen point" })
    this.adjustment = make("section", { className: "m-card", "aria-label": "adjustment", "aria-live": "polite" })
    this.bars = make("section", { className: "m-card", "aria-label": "scale bars" })
    const number = (key, name, value, words, unit = "") => ({ key, name, unit, value: (name_) => value(this.row(name_)), words: (name_) => words(value(this.row(name_))) })
    const short = (value) => (Number.isFinite(value) ? significant(value, SIGMA_DIGITS) : "")
    const columns = [
      { key: "name", name: "point", value: (name) => name },
      number("rays", "rays", (point) => point.rays, String),
      number("sigma", "sigma", (point) => (point.sigma ? Math.max(...point.sigma) : NaN), short),
      number("proposals", "proposals", (point) => point.proposals, (n) => (n ? String(n) : "")),
      { key: "kind", name: "", value: (name) => pointWords(this.row(name)) },
    ]
    this.table = new Table("points", columns, [], (name) => name, { tell: (_, name) => actions.choose(name) })
    element.replaceChildren(this.point, make("section", { className: "m-card m-points" }, make("h2", {}, "Points"), this.table.element), this.adjustment, this.bars)
    hub.on("chosen", () => this.refresh())
  }

  row(name) {
    return { rays: 0, ...this.model.pointOf.get(name), proposals: this.model.proposed.get(name)?.length ?? 0 }
  }

  refresh() {
    const { model } = this
    this.table.renew(model.names, model.chosen)
    this.refreshPoint()
    this.refreshAdjustment()
    this.refreshBars()
  }

  refreshPoint() {
    const { model, actions } = this
    const name = model.chosen
    if (name === null) {
      const hint = "The next click measures a new point. Click a point in this list, or its mark in a photograph, to go on with it."
      this.point.replaceChildren(make("h2", {}, "New point"), make("p", { className: "note" }, hint))
      return
    }
    const point = model.pointOf.get(name) ?? {}
    const marks = model.rays.get(name) ?? []
    const proposals = model.proposed.get(name) ?? []
    const measured = model.measured(proposals).length
    const coordinate = (c) => `${toPrecision(point.X[c], point.sigma?.[c])}${model.unit && ` ${model.unit}`}${point.sigma ? `, sigma ${significant(point.sigma[c], SIGMA_DIGITS)}` : ""}`
    const rows = point.X ? [0, 1, 2].map((c) => ["XYZ"[c], coordinate(c)]) : [["coordinates", "not known yet: mark it in two oriented photographs"]]
    if (point.control) rows.push([point.control.given ? "control of the survey" : "control", point.control.X.map((x, c) => `${x} \u00b1 ${point.control.sigma[c]}`).join(", ")])
    this.point.replaceChildren(
      make("h2", {}, `Point ${name}`),
      facts(rows),
      make(
        "div",
        { className: "v-tools" },
        measured ? button(`Accept ${counted(measured, "proposal")}`, () => actions.accept(name), { title: "Enter", className: "m-main" }) : null,
        proposals.length ? button("Refuse", () => actions.refuse(name), { title: "Shift+X" }) : null,
        button("Rename\u2026", () => actions.rename(name), { title: "R" }),
        button("Control\u2026", () => actions.control(name), { title: "C" }),
        button("Delete point", () => actions.remove(name), { title: "Shift+Delete" }),
      ),
      make("div", { className: "m-fits" }, ...marks.map((mark) => this.fit(mark)), ...proposals.map((proposal) => this.proposal(proposal))),
    )
  }

  /** A mark with the picture of its fit. */
  fit(mark) {
    const { model, actions } = this
    const worst = model.state.adjustment.worst
    const flagged = worst?.flagged && worst.image === mark.image && worst.point === mark.point
    const photograph = model.photograph(mark.image).name
    const address = `fit/${mark.image}/${encodeURIComponent(mark.point)}.png?${new URLSearchParams({ x: mark.x, y: mark.y, kind: mark.kind })}`
    const picture = make("img", { src: address, alt: `fit of ${mark.point} in ${photograph}`, width: 112, height: 112 })
    picture.addEventListener("error", () => (picture.hidden = true))
    return make(
      "figure",
      { className: flagged ? "m-fit m-flagged" : "m-fit" },
      make("button", { type: "button", className: "m-picture", title: `show it in the active pane`, onclick: () => actions.open(mark) }, picture),
      make(
        "figcaption",
        {},
        make("b", {}, photograph),
        make("br"),
        `${mark.kind}${mark.by === "hand" ? " by hand" : mark.automatic ? ", automatic" : ""}`,
        make("br"),
        `${fixed(mark.x, 2)}, ${fixed(mark.y, 2)}`,
        make("br"),
        `sigma ${significant(Math.max(...mark.sigma), SIGMA_DIGITS)} px`,
        ...(mark.residual ? [make("br"), `v ${mark.residual.map((v) => signed(v, 2)).join(", ")} px`] : []),
        ...(Number.isFinite(mark.test) ? [make("br"), flagged ? make("b", { className: "m-bad" }, `fits least, |w| ${fixed(Math.abs(mark.test), 1)}`) : `|w| ${fixed(Math.abs(mark.test), 1)}`] : []),
      ),
    )
  }

  proposal(proposal) {
    const photograph = this.model.photograph(proposal.image).name
    const show = () => this.actions.open(proposal)
    return make(
      "figure",
      { className: "m-fit m-proposal" },
      make(
        "figcaption",
        {},
        make("button", { type: "button", className: "m-link", onclick: show }, photograph),
        make("br"),
        proposal.measured ? `proposed: ${proposal.kind}` : "predicted, nothing measured",
        make("br"),
        `${fixed(proposal.x, 1)}, ${fixed(proposal.y, 1)} px`,
      ),
    )
  }

  refreshAdjustment() {
    const { adjustment, saved } = this.model.state
    const { worst } = adjustment
    const done = adjustment.sigma0_px !== null && adjustment.sigma0_px !== undefined
    const rows = done ? [["sigma0", `${significant(adjustment.sigma0_px)} px`], ["redundancy", String(adjustment.redundancy)]] : []
    const parts = [make("h2", {}, "Adjustment"), make("p", {}, adjustment.state === "running" ? "Adjusting\u2026" : (adjustment.sentence ?? ""))]
    if (done) parts.push(facts(rows))
    if (worst) {
      const photograph = this.model.photograph(worst.image).name
      const words = `${worst.point} in ${photograph} fits least, |w| ${fixed(Math.abs(worst.test), 1)}`
      parts.push(make("p", { className: worst.flagged ? "m-verdict bad" : "note" }, worst.flagged ? `${words}. Look at it: measure it again, or delete it. ` : `${words}. `, button("Show (w)", () => this.actions.openWorst())))
    }
    if (done && !this.model.unit) parts.push(make("p", { className: "note" }, "Scale not known: coordinates have no unit until a bar has both its ends, or three control points are marked."))
    parts.push(make("p", { className: "note" }, `Marks are saved after every change in ${saved}`))
    this.adjustment.replaceChildren(...parts)
  }

  refreshBars() {
    const { bars, unit } = this.model.state
    const row = (bar) =>
      make(
        "tr",
        {},
        make("th", { scope: "row" }, `${bar.start} \u2013 ${bar.end}`),
        make("td", { className: "n" }, `${bar.length} \u00b1 ${bar.sigma} ${unit}`),
        make("td", { className: "n" }, Number.isFinite(bar.residual) ? `v ${signed(bar.residual, 4)}` : ""),
        make("td", {}, bar.given ? "of the survey" : button("Delete", () => this.actions.removeBar(bar), { "aria-label": `delete the bar from ${bar.start} to ${bar.end}` })),
      )
    this.bars.replaceChildren(
      make("h2", {}, "Scale bars"),
      bars.length ? make("div", { className: "scroll" }, make("table", {}, make("tbody", {}, ...bars.map(row)))) : make("p", { className: "note" }, "None. A known length between two points gives the scale."),
      button("Add a bar\u2026", () => this.actions.bar(), { title: "B" }),
    )
  }
}

function pointWords(point) {
  const words = []
  if (point.control) words.push("control")
  if (point["measured automatically"] || point.automatic) words.push("automatic")
  return words.join(", ")
}
