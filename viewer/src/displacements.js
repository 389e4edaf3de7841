// Displacements of the points as exaggerated arrows; points that moved are red.

import * as THREE from "three"
import { lines } from "./rays.js"
import { roundStep } from "./numbers.js"

const LONGEST = 0.2 // of the object's radius: length of the longest arrow

export class Displacements {
  constructor(model, origin, size) {
    this.object = new THREE.Group()
    const vectors = model.a["point.displacement"]
    this.known = Boolean(vectors)
    if (!this.known) return
    const vector = (j) => [0, 1, 2].map((c) => vectors[3 * j + c])
    const longest = Math.max(...Array.from({ length: model.pointCount }, (_, j) => model.displacement(j) || 0))
    this.factor = longest > 0 ? roundStep((LONGEST * size) / longest) : 1
    const ends = [[], []]
    for (let j = 0; j < model.pointCount; j++) {
      if (!(model.displacement(j) > 0)) continue
      const p = model.xyz(j)
      const from = new THREE.Vector3(...[0, 1, 2].map((c) => p[c] - origin[c]))
      const step = new THREE.Vector3(...vector(j)).multiplyScalar(this.factor)
      ends[model.states[model.a["point.state"][j]] === "moved" ? 1 : 0].push(from, from.clone().add(step), ...head(from.clone().add(step), step))
    }
    this.object.add(lines(ends[0], "#7f8791"), lines(ends[1], "#d8342b"))
  }
}

/** The two strokes of an arrow's head. */
function head(tip, step) {
  const side = new THREE.Vector3(0, 0, 1).cross(step)
  if (side.length() < 1e-3 * step.length()) side.set(1, 0, 0).cross(step)
  side.setLength(0.1 * step.length())
  const back = tip.clone().addScaledVector(step, -0.2)
  return [tip, back.clone().add(side), tip, back.clone().sub(side)]
}
