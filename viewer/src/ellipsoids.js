// Error ellipsoids of one standard deviation, exaggerated: one sphere, drawn once for each point.

import * as THREE from "three"

export const MAX_ELLIPSOIDS = 3000 // more are slow without a graphics card, so only the largest are drawn

export class Ellipsoids {
  constructor(model, origin) {
    Object.assign(this, { model, origin, factor: 1 })
    const known = Array.from({ length: model.pointCount }, (_, j) => j).filter((j) => model.sigma(j) > 0)
    known.sort((a, b) => model.sigma(b) - model.sigma(a))
    this.shown = known.slice(0, MAX_ELLIPSOIDS)
    this.known = known.length
    this.typical = known.length ? model.sigma(known[Math.floor(known.length / 2)]) : 0
    const sphere = new THREE.IcosahedronGeometry(1, this.shown.length > 500 ? 1 : 2)
    const material = new THREE.MeshLambertMaterial({ color: "#6d8fd1", transparent: true, opacity: 0.55 })
    this.object = new THREE.InstancedMesh(sphere, material, this.shown.length)
    this.object.frustumCulled = false
    this.object.visible = false
    this.scale(1)
  }

  /** Set the exaggeration. */
  scale(factor) {
    this.factor = factor
    const matrix = new THREE.Matrix4()
    this.shown.forEach((j, k) => {
      const [a, b, c, d, e, f] = root(this.model.covariance(j), factor)
      const p = this.model.xyz(j)
      const [x, y, z] = [0, 1, 2].map((r) => p[r] - this.origin[r])
      matrix.set(a, 0, 0, x, b, c, 0, y, d, e, f, z, 0, 0, 0, 1)
      this.object.setMatrixAt(k, matrix)
    })
    this.object.instanceMatrix.needsUpdate = true
  }
}

/** Lower triangle of the Cholesky root of a covariance: it turns the unit sphere into the ellipsoid. */
function root(q, factor) {
  const at = (x) => Math.sqrt(Math.max(x, 0))
  const a = at(q[0])
  const b = a ? q[1] / a : 0
  const d = a ? q[2] / a : 0
  const c = at(q[3] - b * b)
  const e = c ? (q[4] - d * b) / c : 0
  return [a, b, c, d, e, at(q[5] - d * d - e * e)].map((x) => x * factor)
}
