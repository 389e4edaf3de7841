// What the page knows: the last state of the program, and what the person has chosen on this page.

import { byName } from "../numbers.js"

export const KINDS = ["target", "ring", "saddle", "corner", "cross", "window", "hand"] // chosen with the keys 1 to 7

export class Model {
  constructor(hub) {
    this.hub = hub
    this.state = null
    this.aim = { point: null } // what the person has chosen last: a point, or a new one (null), which its click names
    this.kind = null // of the next click; null: whatever fits
    this.sigma_px = 1 // of a mark by hand
    this.hovered = null // photograph under the pointer
    this.names = [] // of all points, in natural order
  }

  /** Name of the point that the next click measures; null: a new point. */
  get chosen() {
    return this.aim.point
  }

  take(state) {
    this.state = state
    this.pointOf = new Map(state.points.map((point) => [point.name, point]))
    this.marks = grouped(state.marks, "image")
    this.rays = grouped(state.marks, "point")
    this.proposals = grouped(state.proposals, "image")
    this.proposed = grouped(state.proposals, "point")
    this.lines = grouped(state.lines, "image")
    this.names = [...new Set([...this.pointOf.keys(), ...this.rays.keys()])].sort(byName)
    this.usualResidual = usualResidual(state.marks)
    const known = (name) => this.pointOf.has(name) || this.rays.has(name)
    if (this.chosen !== null && !known(this.chosen)) this.aim.point = null
  }

  photograph(image) {
    return this.state.photographs[image]
  }

  markOf(image, point) {
    return (this.rays.get(point) ?? []).find((mark) => mark.image === image) ?? null
  }

  proposalOf(image, point) {
    return (this.proposed.get(point) ?? []).find((proposal) => proposal.image === image) ?? null
  }

  /** Those of proposals that were measured: only they can be accepted. */
  measured(proposals) {
    return proposals.filter((proposal) => proposal.measured)
  }

  /** What a photograph is in need of, in a few words. */
  stateOf(image) {
    const { changed, oriented, needs } = this.photograph(image)
    if (changed) return { words: "changed", look: "m-bad" }
    if (oriented) return { words: "oriented", look: "m-good" }
    return { words: needs ? `needs ${needs}` : "not oriented", look: "m-fair" }
  }

  /**
   * The point that a click in a photograph measures; null: a new one.
   * A chosen point that is marked there already is left alone. In a photograph that is not oriented a point with
   * coordinates follows, because the photograph waits for it; elsewhere the click makes a new point. The best one is
   * farthest from all lines through points that are marked there: points on a line do not orient a photograph.
   */
  pointFor(image, chosen = this.chosen) {
    if (chosen === null || !this.markOf(image, chosen)) return chosen
    if (this.photograph(image).oriented) return null
    const place = (name) => this.pointOf.get(name)?.X ?? this.pointOf.get(name)?.control?.X
    const marked = (this.marks.get(image) ?? []).map((mark) => place(mark.point)).filter(Boolean)
    let best = { name: null, away: -Infinity }
    for (const name of this.names) {
      if (!place(name) || this.markOf(image, name)) continue
      const away = distanceFrom(marked, place(name))
      if (away > best.away) best = { name, away }
    }
    return best.name
  }

  /** The point that stands out on the page: that of the next click under the pointer, or the chosen one. */
  get told() {
    return this.hovered === null ? this.chosen : (this.pointFor(this.hovered) ?? this.chosen)
  }

  /** The person chooses a point, or a new one (null): clicks before it keep their own aim. */
  choose(point) {
    const before = this.chosen
    this.aim = { point }
    if (point !== before) this.hub.tell("chosen", point)
  }

  /** A click has measured a point: further clicks of the same aim measure it too. */
  hit(aim, point) {
    const before = this.chosen
    aim.point = point
    if (this.chosen !== before) this.hub.tell("chosen", this.chosen)
  }

  /** The unit of lengths; empty as long as nothing gives the scale. */
  get unit() {
    return this.state.scaled ? this.state.unit : ""
  }
}

/** A usual residual in px: the RMS, or the median sigma of the marks where that is larger; 0 without residuals. */
function usualResidual(marks) {
  const adjusted = marks.filter((mark) => mark.residual)
  if (!adjusted.length) return 0
  const squares = adjusted.flatMap((mark) => mark.residual.map((v) => v * v))
  const sigmas = adjusted.map((mark) => Math.max(...mark.sigma)).sort((a, b) => a - b)
  return Math.max(Math.sqrt(squares.reduce((sum, square) => sum + square, 0) / squares.length), sigmas[sigmas.length >> 1])
}

/** The least distance of a point from the lines through others; from the point, if there is one other only. */
function distanceFrom(others, [x, y, z]) {
  let least = Infinity
  for (const [i, a] of others.entries()) {
    const d = [x - a[0], y - a[1], z - a[2]]
    const square = d.reduce((sum, v) => sum + v * v, 0)
    if (others.length === 1) return Math.sqrt(square)
    for (const b of others.slice(i + 1)) {
      const u = [b[0] - a[0], b[1] - a[1], b[2] - a[2]]
      const along = d.reduce((sum, v, c) => sum + v * u[c], 0) / Math.hypot(...u)
      least = Math.min(least, Math.sqrt(Math.max(0, square - along * along)))
    }
  }
  return others.length ? least : 0
}

function grouped(rows, key) {
  const groups = new Map()
  for (const row of rows) {
    if (!groups.has(row[key])) groups.set(row[key], [])
    groups.get(row[key]).push(row)
  }
  return groups
}
