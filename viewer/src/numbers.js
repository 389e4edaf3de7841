// Numbers as the report writes them (sfm/report/phrases.py).

export const UNKNOWN = "not known"

export function significant(value, digits = 3) {
  if (!Number.isFinite(value)) return UNKNOWN
  if (value === 0) return "0"
  const exponent = Math.floor(Math.log10(Math.abs(value)))
  if (exponent >= -6 && exponent < 7) return value.toFixed(Math.max(0, digits - 1 - exponent))
  return value.toExponential(digits - 1)
}

/** A coordinate to the second digit of its standard deviation, six decimals if that is not known. */
export function toPrecision(value, sigma) {
  if (!Number.isFinite(value)) return UNKNOWN
  const known = Number.isFinite(sigma) && sigma > 0
  const decimals = known ? Math.min(12, Math.max(0, 1 - Math.floor(Math.log10(sigma)))) : 6
  return value.toFixed(decimals)
}

/** A standard deviation in words: fixed coordinates and adjustments without covariance have none. */
export function sigmaWords(sigma, unit = "") {
  if (sigma === 0) return "fixed"
  return Number.isFinite(sigma) ? `sigma ${significant(sigma)} ${unit}`.trimEnd() : `sigma ${UNKNOWN}`
}

export function fixed(value, decimals) {
  return Number.isFinite(value) ? value.toFixed(decimals) : UNKNOWN
}

/** A number of things: one point, two points. */
export function counted(count, noun) {
  return `${count} ${noun}${count === 1 ? "" : "s"}`
}

export function signed(value, decimals) {
  if (!Number.isFinite(value)) return UNKNOWN
  return (value >= 0 ? "+" : "") + value.toFixed(decimals)
}

/** The largest 1, 2 or 5 times a power of ten that does not exceed a value. */
export function roundStep(value) {
  const power = 10 ** Math.floor(Math.log10(value))
  return [5, 2, 1].find((step) => step * power <= value * (1 + 1e-9)) * power
}

/** Compare names in natural order, with numbers by value. */
export const byName = new Intl.Collator("en", { numeric: true }).compare
