// Names, the scale and the axes, drawn over the scene; names that would overlap others are omitted.

import * as THREE from "three"
import { roundStep, significant } from "./numbers.js"

const FONT = "12px system-ui, sans-serif"
const HIGH_PX = 14 // of a line of names
const MAX_NAMES = 400
const MAX_LETTERS = 24

export function drawLabels(scene, dark) {
  const ratio = scene.renderer.getPixelRatio()
  const context = scene.overlay.getContext("2d")
  context.setTransform(ratio, 0, 0, ratio, 0, 0)
  const [width, height] = [scene.canvas.clientWidth, scene.canvas.clientHeight]
  context.clearRect(0, 0, width, height)
  context.font = FONT
  const ink = dark ? "#e6edf5" : "#1b2430"
  const paper = dark ? "rgba(40,48,58,.8)" : "rgba(255,255,255,.8)"
  const taken = []
  let left = MAX_NAMES
  const put = (text, position, must = false) => {
    const at = left > 0 || must ? scene.project(position) : null
    if (!at || at[0] < 0 || at[1] < 0 || at[0] > width || at[1] > height) return
    const short = text.length > MAX_LETTERS ? `${text.slice(0, MAX_LETTERS)}\u2026` : text
    const box = [at[0], at[1] - HIGH_PX, at[0] + 7 + context.measureText(short).width, at[1]]
    if (!must && taken.some((other) => overlap(box, other))) return
    taken.push(box)
    left -= 1
    context.lineWidth = 3
    context.strokeStyle = paper
    context.strokeText(short, at[0] + 7, at[1] - 5)
    context.fillStyle = ink
    context.fillText(short, at[0] + 7, at[1] - 5)
  }
  const { model, selected } = scene
  const nameOf = { point: model.points, photograph: model.photographs }
  const placeOf = { point: (k) => model.xyz(k), photograph: (k) => model.centre(k) }
  if (selected) put(nameOf[selected.kind][selected.index], scene.local(placeOf[selected.kind](selected.index)), true)
  if (scene.names) {
    if (scene.photographs.object.visible) {
      for (let i = 0; i < model.photoCount; i++) put(model.photographs[i], scene.local(model.centre(i)))
    }
    for (const j of byPriority(model)) put(model.points[j], scene.local(model.xyz(j)))
  }
  scene.named = taken
  scaleBar(scene, context, height, ink)
  axes(scene, context, width, height, ink)
}

function overlap(a, b) {
  return a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3]
}

/** Points in the order in which their names are placed: control, ends of scale bars, others. */
function byPriority(model) {
  const first = [...model.control, ...model.bars.flatMap((bar) => [bar.from, bar.to])]
  return new Set([...first, ...Array(model.pointCount).keys()])
}

function scaleBar(scene, context, height, ink) {
  const unit = scene.unitsPerPixel()
  const length = roundStep(110 * unit)
  const px = length / unit
  context.strokeStyle = context.fillStyle = ink
  context.lineWidth = 2
  context.beginPath()
  context.moveTo(14, height - 22)
  context.lineTo(14, height - 16)
  context.lineTo(14 + px, height - 16)
  context.lineTo(14 + px, height - 22)
  context.stroke()
  const where = scene.camera.isOrthographicCamera ? "" : " at the centre"
  context.fillText(`${+significant(length)} ${scene.model.unit}${where}`, 14, height - 28)
}

function axes(scene, context, width, height, ink) {
  const at = [width - 44, height - 40]
  const turned = scene.camera.quaternion.clone().invert()
  for (const [name, axis, colour] of [["X", [1, 0, 0], "#d8342b"], ["Y", [0, 1, 0], "#2f9e5c"], ["Z", [0, 0, 1], "#2f6fd0"]]) {
    const v = new THREE.Vector3(...axis).applyQuaternion(turned)
    const end = [at[0] + 26 * v.x, at[1] - 26 * v.y]
    context.strokeStyle = colour
    context.lineWidth = 2
    context.beginPath()
    context.moveTo(...at)
    context.lineTo(...end)
    context.stroke()
    context.fillStyle = ink
    context.fillText(name, end[0] + (v.x >= 0 ? 3 : -10), end[1] + 4)
  }
}
