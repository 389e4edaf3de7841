// What the page knows: the last state of the program, and what the person has chosen on this page.

import { byName } from "../numbers.js"

export const KINDS = ["target", "ring", "saddle", "corner", "cross", "window", "hand"] // chosen with the keys 1 to 7

export class Model {
  constructor(hub) {
    this.hub = hub
    this.state = null
    this.chosen = null // name of the point that the next click measures; null: a new point
    this.kind = null // of the next click; null: whatever fits
    this.sigma_px = 1 // of a mark by hand
    this.hovered = null // photograph under the pointer
  }

  take(state) {
    this.state = state
    this.pointOf = new Map(state.points.map((point) => [point.name, point]))
    this.marks = grouped(state.marks, "image")
    this.rays = grouped(state.marks, "point")
    this.proposals = grouped(state.proposals, "image")
    this.proposed = grouped(state.proposals, "point")
    this.lines = grouped(state.lines, "image")
    const known = (name) => this.pointOf.has(name) || this.rays.has(name)
    if (this.chosen !== null && !known(this.chosen)) this.chosen = null
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

  /** Names of all points, in natural order. */
  names() {
    return [...new Set([...this.pointOf.keys(), ...this.rays.keys()])].sort(byName)
  }

  /**
   * The point that a click in a photograph measures; null: a new one.
   * A chosen point that is marked there already is left alone. In a photograph that is not oriented the next point with
   * coordinates follows, because the photograph waits for it; elsewhere the click makes a new point.
   */
  pointFor(image) {
    const { chosen } = this
    if (chosen === null || !this.markOf(image, chosen)) return chosen
    if (this.photograph(image).oriented) return null
    const known = (point) => point?.X || point?.control
    const waiting = this.names().filter((name) => known(this.pointOf.get(name)) && !this.markOf(image, name))
    return waiting.find((name) => byName(name, chosen) > 0) ?? waiting[0] ?? null
  }

  /** The point that stands out on the page: that of the next click under the pointer, or the chosen one. */
  get told() {
    return this.hovered === null ? this.chosen : (this.pointFor(this.hovered) ?? this.chosen)
  }

  choose(point) {
    if (point === this.chosen) return
    this.chosen = point
    this.hub.tell("chosen", point)
  }

  /** RMS of the residuals in px; 0 without residuals. */
  get rms() {
    const squares = this.state.marks.filter((mark) => mark.residual).flatMap((mark) => mark.residual.map((v) => v * v))
    return squares.length ? Math.sqrt(squares.reduce((sum, square) => sum + square, 0) / squares.length) : 0
  }
}

function grouped(rows, key) {
  const groups = new Map()
  for (const row of rows) {
    if (!groups.has(row[key])) groups.set(row[key], [])
    groups.get(row[key]).push(row)
  }
  return groups
}
