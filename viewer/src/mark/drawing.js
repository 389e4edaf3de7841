// What is drawn over a photograph: marks, proposals with their ellipses, lines, residual vectors and names.

import { GREEN, RED, YELLOW } from "../crops.js"
import { roundStep, significant } from "../numbers.js"

const BLUE = "#5ab4ff"
const WHITE = "#ffffff"
const HALO = "rgba(0, 0, 0, .7)"
const GAP = 4 // the middle of a mark is left free, so that what is marked stays visible
const ARM = 11
const ARROW = 16 // length of a usual residual
const CELL = 14 // names in the same cell would overlap
const AWAY = [13, -9] // from the mark to its name
const MAX_TEXT = 40 // characters of a name over a photograph
const MARGIN = 40 // beyond the edge, within which a mark is still drawn

/**
 * Draw all that belongs to a photograph; lengths are in px of the screen.
 * @param frame of {at, scale, turn, width, height}: `at` gives the place on the canvas of a place in the pixel frame.
 * @param shown of {names, residuals, sight, cursor, pending}.
 */
export function drawOverlay(context, frame, model, image, shown) {
  const told = model.told
  const inside = ([x, y]) => x > -MARGIN && y > -MARGIN && x < frame.width + MARGIN && y < frame.height + MARGIN
  const labels = new Labels(context, shown.names)
  for (const line of model.lines.get(image) ?? []) {
    if (line.point === told) polyline(context, frame, line.xy, BLUE, [8, 5])
  }
  for (const xy of shown.sight) polyline(context, frame, xy, YELLOW, [2, 4])
  const own = model.markOf(image, told)
  if (own) labels.keep(told, ...frame.at([own.x, own.y])) // the chosen name comes first
  for (const proposal of model.proposals.get(image) ?? []) drawProposal(context, frame, proposal, labels, inside, proposal.point === told)
  const marks = (model.marks.get(image) ?? []).map((mark) => ({ mark, place: frame.at([mark.x, mark.y]) })).filter(({ place }) => inside(place))
  const { worst } = model.state.adjustment
  const isFlagged = (mark) => Boolean(worst?.flagged) && worst.image === image && worst.point === mark.point
  const [special, plain] = [[], []]
  for (const one of marks) (one.mark === own || isFlagged(one.mark) ? special : plain).push(one)
  drawPlain(context, plain, labels)
  for (const { mark, place } of special) drawSpecial(context, mark, place, labels, isFlagged(mark), mark === own)
  if (shown.residuals) drawResiduals(context, frame, marks, model.usualResidual)
  for (const place of shown.pending) drawPending(context, frame.at(place))
  if (shown.cursor) drawCursor(context, frame, shown.cursor)
}

/** Draw all marks that do not stand out with one path, because a photograph may have thousands. */
function drawPlain(context, marks, labels) {
  for (const automatic of [true, false]) {
    const alike = marks.filter(({ mark }) => mark.automatic === automatic)
    outlined(context, GREEN, automatic ? 1 : 1.5, () => alike.forEach(({ mark, place }) => symbol(context, mark, place)))
  }
  for (const { mark, place: [x, y] } of marks) labels.put(mark.point, x + AWAY[0], y + AWAY[1], GREEN, false)
}

function symbol(context, mark, [x, y]) {
  if (mark.by === "hand") context.rect(x - 7, y - 7, 14, 14) // a place that a person stated
  else cross(context, x, y, mark.automatic ? 8 : ARM)
}

function drawSpecial(context, mark, place, labels, flagged, chosen) {
  const [x, y] = place
  const colour = flagged ? RED : GREEN
  outlined(context, colour, 2.2, () => symbol(context, mark, place))
  if (chosen) outlined(context, WHITE, 1.5, () => context.arc(x, y, ARM + 5, 0, 2 * Math.PI))
  if (flagged) outlined(context, RED, 2, () => context.arc(x, y, ARM + 9, 0, 2 * Math.PI))
  labels.put(flagged ? `${mark.point}, w ${significant(mark.test, 2)}` : mark.point, x + AWAY[0], y + AWAY[1], chosen ? WHITE : colour, chosen || flagged)
}

function drawProposal(context, frame, proposal, labels, inside, chosen) {
  const place = frame.at([proposal.x, proposal.y])
  if (!inside(place)) return
  const [x, y] = place
  const { a, b, angle_deg } = proposal.ellipse
  const [long, short] = [Math.max(3, a * frame.scale), Math.max(3, b * frame.scale)]
  outlined(context, BLUE, chosen ? 2.2 : 1.3, () => context.ellipse(x, y, long, short, frame.turn + (angle_deg * Math.PI) / 180, 0, 2 * Math.PI))
  if (proposal.measured) outlined(context, BLUE, 1.3, () => cross(context, x, y, 9))
  labels.put(proposal.measured ? `${proposal.point}?` : `(${proposal.point})`, x + AWAY[0], y + AWAY[1], BLUE, chosen)
}

function drawResiduals(context, frame, marks, usual) {
  if (!usual) return
  const perPixel = ARROW / usual // px of the screen for 1 px of residual
  outlined(context, YELLOW, 1.5, () => {
    for (const { mark, place: [x, y] } of marks) {
      if (!mark.residual) continue
      const [u, v] = frame.direction(mark.residual)
      context.moveTo(x, y)
      context.lineTo(x + perPixel * u, y + perPixel * v)
    }
  })
  const round = roundStep((60 / ARROW) * usual) // the scale, at most 60 px of the screen long
  const [left, low] = [12, frame.height - 12]
  outlined(context, YELLOW, 2, () => {
    context.moveTo(left, low)
    context.lineTo(left + perPixel * round, low)
  })
  words(context, `residual ${significant(round, 1)} px`, left + perPixel * round + 6, low + 4, YELLOW)
}

function drawPending(context, [x, y]) {
  outlined(context, WHITE, 1.5, () => context.arc(x, y, 9, 0, 2 * Math.PI), [3, 3])
}

/** The crosshair of the keyboard, or the word beside the pointer: what a click here measures. */
function drawCursor(context, frame, { place, text, keyboard }) {
  const [x, y] = frame.at(place)
  if (keyboard) {
    outlined(context, WHITE, 1.5, () => {
      cross(context, x, y, 20)
      context.rect(x - 1, y - 1, 2, 2)
    })
  }
  words(context, text, x + 16, y + 22, WHITE)
}

function cross(context, x, y, arm) {
  for (const [u, v] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    context.moveTo(x + GAP * u, y + GAP * v)
    context.lineTo(x + arm * u, y + arm * v)
  }
}

function polyline(context, frame, xy, colour, dashes) {
  outlined(context, colour, 1.5, () => xy.forEach((place, k) => context[k ? "lineTo" : "moveTo"](...frame.at(place))), dashes)
}

/** Stroke a path twice, so that it is seen on light and on dark. */
function outlined(context, colour, width, path, dashes = []) {
  context.setLineDash(dashes)
  context.beginPath()
  path()
  context.strokeStyle = HALO
  context.lineWidth = width + 1.6
  context.stroke()
  context.strokeStyle = colour
  context.lineWidth = width
  context.stroke()
  context.setLineDash([])
}

function words(context, whole, x, y, colour, bold = false) {
  const text = whole.length > MAX_TEXT ? `${whole.slice(0, MAX_TEXT)}\u2026` : whole
  context.font = `${bold ? "600 " : ""}12px system-ui, sans-serif`
  context.strokeStyle = HALO
  context.lineWidth = 3
  context.lineJoin = "round"
  context.strokeText(text, x, y)
  context.fillStyle = colour
  context.fillText(text, x, y)
}

/** Names that do not lie over one another; those that matter are always there. */
class Labels {
  constructor(context, shown) {
    this.context = context
    this.shown = shown
    this.taken = new Set()
  }

  cells(text, x, y) {
    const length = Math.ceil((text.length * 7) / CELL)
    return Array.from({ length }, (_, c) => `${Math.floor(x / CELL) + c},${Math.floor(y / CELL)}`)
  }

  /** Keep the place of the name beside a mark. */
  keep(text, x, y) {
    for (const cell of this.cells(text, x + AWAY[0], y + AWAY[1])) this.taken.add(cell)
  }

  put(text, x, y, colour, matters) {
    if (!this.shown && !matters) return
    const cells = this.cells(text, x, y)
    if (!matters && cells.some((cell) => this.taken.has(cell))) return
    for (const cell of cells) this.taken.add(cell)
    words(this.context, text, x, y, colour, matters)
  }
}
