// The rays of the selected point or photograph; rejected ones in red, along their measured direction.

import * as THREE from "three"

export class Rays {
  constructor(model, origin) {
    Object.assign(this, { model, origin, on: false })
    this.accepted = lines([], "#2f9e5c")
    this.rejected = lines([], "#d8342b")
    this.accepted.material.transparent = true
    this.accepted.material.opacity = 0.75
    this.object = new THREE.Group()
    this.object.add(this.accepted, this.rejected)
    this.all = lines([], "#d8342b")
    this.all.visible = false
    this.object.add(this.all)
  }

  show(found) {
    this.found = found
    const model = this.model
    let rays = []
    if (this.on && found?.kind === "point") rays = model.raysOfPoint(found.index)
    if (this.on && found?.kind === "photograph") rays = model.raysOfPhoto(found.index)
    const ends = [[], []]
    for (const k of rays) ends[model.a["ray.rejected"][k]].push(...this.ends(k))
    this.accepted.geometry.dispose()
    this.rejected.geometry.dispose()
    this.accepted.geometry = new THREE.BufferGeometry().setFromPoints(ends[0])
    this.rejected.geometry = new THREE.BufferGeometry().setFromPoints(ends[1])
  }

  /** Show the rejected rays of all points. */
  showRejected(on) {
    if (on && !this.all.userData.made) {
      const found = []
      for (let k = 0; k < this.model.rayCount; k++) if (this.model.rejected(k)) found.push(...this.ends(k))
      this.all.geometry = new THREE.BufferGeometry().setFromPoints(found)
      this.all.userData.made = true
    }
    this.all.visible = on
  }

  /** The projection centre, and the position of the measured ray at the depth of the point. */
  ends(k) {
    const model = this.model
    const i = model.a["ray.photo"][k]
    const p = model.xyz(model.a["ray.point"][k])
    const c = model.centre(i)
    const R = model.rotation(i)
    const [vx, vy] = model.pair("ray.v", k)
    const depth = -[0, 1, 2].reduce((sum, r) => sum + R[3 * r + 2] * (p[r] - c[r]), 0)
    const unit = Number.isFinite(vx) ? depth / model.camera(i).c_px : 0
    // measured = computed - v; in the image frame y is up
    const [dx, dy] = unit ? [-vx * unit, vy * unit] : [0, 0]
    const end = [0, 1, 2].map((r) => p[r] + R[3 * r] * dx + R[3 * r + 1] * dy - this.origin[r])
    return [new THREE.Vector3(...[0, 1, 2].map((r) => c[r] - this.origin[r])), new THREE.Vector3(...end)]
  }
}

export function lines(ends, color) {
  const geometry = new THREE.BufferGeometry().setFromPoints(ends)
  return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color }))
}
