// The data of a page: names and other texts as JSON, numbers as arrays, pictures as base64.
// The writer is sfm/report/viewer/embedded.py.

const TYPES = { f8: Float64Array, f4: Float32Array, u4: Uint32Array, u1: Uint8Array }

/** Return the unpacked content of an inert script element, or null if there is none. */
export async function unpack(id) {
  const text = document.getElementById(id)?.textContent.trim()
  if (!text) return null
  const binary = atob(text)
  const packed = new Uint8Array(binary.length)
  for (let k = 0; k < packed.length; k++) packed[k] = binary.charCodeAt(k)
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))
  const buffer = await new Response(stream).arrayBuffer()
  const size = new DataView(buffer).getUint32(0, true)
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)))
  const arrays = {}
  for (const [name, [type, offset, count]] of Object.entries(header.arrays)) {
    arrays[name] = new TYPES[type](buffer, offset, count)
  }
  return new Model(header, arrays)
}

/** The result that a page shows. Points, photographs and rays are addressed by index. */
class Model {
  constructor(header, arrays) {
    Object.assign(this, header)
    this.a = arrays
    this.pointCount = this.points.length
    this.photoCount = this.photographs.length
    this.rayCount = arrays["ray.point"].length
    this.firstOfPoint = starts(arrays["ray.point"], this.pointCount)
    const photo = arrays["ray.photo"]
    this.firstOfPhoto = starts(photo, this.photoCount)
    this.rayOrder = new Uint32Array(this.rayCount)
    const next = this.firstOfPhoto.slice()
    for (let k = 0; k < this.rayCount; k++) this.rayOrder[next[photo[k]]++] = k
    this.firstMark = starts(arrays["mark.photo"], this.photoCount)
    // Image points of a plan are predicted and have no residuals.
    this.hasResiduals = ["photo.rms", "point.rms"].some((key) => arrays[key].some((rms) => rms > 0))
    this.cropOfRay = new Map()
    arrays["crop.ray"].forEach((ray, k) => this.cropOfRay.set(ray, k))
  }

  /** Coordinates of a point, object unit. */
  xyz(j) {
    return this.a["point.xyz"].subarray(3 * j, 3 * j + 3)
  }

  /** Covariance of a point: xx, xy, xz, yy, yz, zz; NaN if unknown. */
  covariance(j) {
    return this.a["point.covariance"].subarray(6 * j, 6 * j + 6)
  }

  sigmas(j) {
    const q = this.covariance(j)
    return [Math.sqrt(q[0]), Math.sqrt(q[3]), Math.sqrt(q[5])]
  }

  /** Root mean square of sX, sY, sZ. */
  sigma(j) {
    const q = this.covariance(j)
    return Math.sqrt((q[0] + q[3] + q[5]) / 3)
  }

  raysOfPoint(j) {
    return range(this.firstOfPoint[j], this.firstOfPoint[j + 1])
  }

  raysOfPhoto(i) {
    return this.rayOrder.subarray(this.firstOfPhoto[i], this.firstOfPhoto[i + 1])
  }

  marksOfPhoto(i) {
    return range(this.firstMark[i], this.firstMark[i + 1])
  }

  pair(name, k) {
    return this.a[name].subarray(2 * k, 2 * k + 2)
  }

  /** Larger of the two |w| of a ray. */
  worstW(k) {
    const [x, y] = this.pair("ray.w", k)
    return Math.max(Math.abs(x), Math.abs(y))
  }

  /** Length of the displacement of a point; NaN if unknown. */
  displacement(j) {
    return Math.hypot(...this.a["point.displacement"].subarray(3 * j, 3 * j + 3))
  }

  residual(k) {
    return Math.hypot(...this.pair("ray.v", k))
  }

  rejected(k) {
    return this.a["ray.rejected"][k] === 1
  }

  camera(i) {
    return this.cameras[this.a["photo.camera"][i]]
  }

  centre(i) {
    return this.a["photo.position"].subarray(3 * i, 3 * i + 3)
  }

  /** Rotation of a photograph from image to object axes, by rows. */
  rotation(i) {
    return this.a["photo.rotation"].subarray(9 * i, 9 * i + 9)
  }

  /** Standard deviation of the distance between two points, from their joint covariance; NaN if unknown. */
  distanceSigma(i, j) {
    const pairs = this.a["pair.sigma"]
    if (!pairs) return NaN
    const [a, b] = i < j ? [i, j] : [j, i]
    return pairs[a * this.pointCount - (a * (a + 1)) / 2 + b - a - 1]
  }

  /** The same from the separate covariances of the two points. */
  distanceSigmaAlone(i, j) {
    const a = this.xyz(i)
    const b = this.xyz(j)
    const u = [b[0] - a[0], b[1] - a[1], b[2] - a[2]]
    const length = Math.hypot(...u)
    let sum = 0
    for (const q of [this.covariance(i), this.covariance(j)]) {
      sum += q[0] * u[0] ** 2 + q[3] * u[1] ** 2 + q[5] * u[2] ** 2
      sum += 2 * (q[1] * u[0] * u[1] + q[2] * u[0] * u[2] + q[4] * u[1] * u[2])
    }
    return Math.sqrt(sum) / length
  }

  /** Address of an embedded picture, or "" if it is beside the page. */
  picture(kind, k) {
    const length = this.a[`${kind}.length`]?.[k]
    if (!length) return ""
    this.base64 ??= document.getElementById("viewer-pictures").textContent.trim()
    const start = this.a[`${kind}.start`][k]
    return `data:image/jpeg;base64,${this.base64.slice(4 * start, 4 * (start + length))}`
  }

  /** Address of the picture of a crop: embedded alone, or with others in a file beside the page. */
  cropAddress(crop) {
    return this.picture("crop", crop) || this.crop_files[this.a["ray.photo"][this.a["crop.ray"][crop]]]
  }

  /** Left, top and side of a crop in its picture, px. */
  cropCell(crop) {
    const side = this.a["crop.frame"][4 * crop + 3]
    if (this.a["crop.length"][crop]) return [0, 0, side]
    const cell = this.a["crop.cell"][crop]
    return [this.crop_px * (cell % this.crop_columns), this.crop_px * Math.floor(cell / this.crop_columns), side]
  }
}

function starts(index, count) {
  const first = new Uint32Array(count + 1)
  for (const k of index) first[k + 1]++
  for (let k = 0; k < count; k++) first[k + 1] += first[k]
  return first
}

/** The integers from start up to, but not including, end. */
export function range(start, end) {
  const found = new Uint32Array(end - start)
  for (let k = 0; k < found.length; k++) found[k] = start + k
  return found
}
