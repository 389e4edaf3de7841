// Tables of any length, which can be sorted, filtered, copied and used by keyboard. Only visible rows are in the page.

import { button, copyText, make } from "./page.js"
import { byName } from "./numbers.js"

const ROW_PX = 27
const SPARE = 8 // rows above and below the visible ones

export class Table {
  /**
   * @param columns of {key, name, unit, value(k), words(k)}; a column without `words` is text.
   * @param rows indices of the rows.
   * @param found returns the selection that a row stands for.
   */
  constructor(what, columns, rows, found, hub) {
    Object.assign(this, { what, columns, rows, found, hub, all: rows, sorted: null, active: -1 })
    this.search = make("input", { type: "search", placeholder: filterHint(columns), "aria-label": `filter ${what}` })
    this.search.addEventListener("input", () => this.filter())
    this.count = make("span", { className: "v-count", "aria-live": "polite" })
    this.body = make("tbody")
    this.head = make("tr", {}, ...columns.map((column) => this.heading(column)))
    this.table = make("table", { "aria-label": what, "aria-rowcount": rows.length }, make("thead", {}, this.head), this.body)
    this.box = make("div", { className: "v-rows", tabIndex: 0, role: "region", "aria-label": `${what}; arrow keys select a row` }, this.table)
    this.box.addEventListener("scroll", () => this.draw())
    this.box.addEventListener("keydown", (event) => this.key(event))
    this.element = make(
      "div",
      { className: "v-table" },
      make("div", { className: "v-tools" }, this.search, this.count, button("Copy as CSV", (event) => this.copy(event.target))),
      this.box,
    )
    new ResizeObserver(() => this.draw()).observe(this.box)
    this.filter()
  }

  heading(column) {
    const name = column.unit ? `${column.name} [${column.unit}]` : column.name
    const cell = make("th", { scope: "col", className: column.words ? "n" : "", "aria-sort": "none" })
    cell.append(button(name, () => this.sort(column), { className: "v-sort" }))
    column.cell = cell
    return cell
  }

  sort(column) {
    const down = this.sorted === column ? !this.down : Boolean(column.words)
    Object.assign(this, { sorted: column, down })
    for (const one of this.columns) one.cell.setAttribute("aria-sort", one === column ? (down ? "descending" : "ascending") : "none")
    this.order()
  }

  order() {
    const column = this.sorted
    if (column) {
      const sign = this.down ? -1 : 1
      const last = (x) => (Number.isNaN(x) ? 1 : 0)
      const values = new Map()
      for (const k of this.rows) values.set(k, column.value(k))
      this.rows = this.rows.slice().sort((a, b) => {
        const [x, y] = [values.get(a), values.get(b)]
        if (!column.words) return sign * byName(x, y) || a - b
        return last(x) - last(y) || sign * (x - y) || a - b
      })
    }
    this.draw()
  }

  filter() {
    const accepts = condition(this.search.value, this.columns)
    this.search.classList.toggle("v-wrong", accepts === null)
    this.rows = accepts ? this.all.filter(accepts) : this.all
    this.count.textContent = this.rows.length === this.all.length ? `${this.all.length}` : `${this.rows.length} of ${this.all.length}`
    this.table.setAttribute("aria-rowcount", this.rows.length)
    this.box.scrollTop = 0
    this.order()
  }

  /** Take over other rows, and the active one, where the table was scrolled to. */
  renew(rows, active) {
    const top = this.box.scrollTop
    this.all = rows
    this.filter()
    this.box.scrollTop = top
    if (active !== this.active) this.reveal(active)
  }

  draw() {
    const height = this.box.clientHeight || 300
    const first = Math.max(0, Math.floor(this.box.scrollTop / ROW_PX) - SPARE)
    const end = Math.min(this.rows.length, first + Math.ceil(height / ROW_PX) + 2 * SPARE)
    const rows = []
    for (let r = first; r < end; r++) rows.push(this.row(r))
    this.body.replaceChildren(spacer(first, this.columns.length), ...rows, spacer(this.rows.length - end, this.columns.length))
  }

  row(r) {
    const k = this.rows[r]
    const cells = this.columns.map((column, c) => {
      const text = column.words ? column.words(k) : column.value(k)
      return make(c ? "td" : "th", c ? { className: column.words ? "n" : "v-text" } : { scope: "row", className: "v-text" }, text)
    })
    const row = make("tr", { className: k === this.active ? "v-chosen" : "", "aria-rowindex": r + 1, onclick: () => this.choose(k) }, ...cells)
    row.dataset.row = k
    return row
  }

  choose(k) {
    this.active = k
    this.hub.tell("select", this.found(k))
    this.draw()
  }

  /** Show a row that was selected elsewhere. */
  reveal(k) {
    this.active = k
    const r = this.rows.indexOf(k)
    if (r >= 0) {
      const top = r * ROW_PX
      if (top < this.box.scrollTop || top > this.box.scrollTop + this.box.clientHeight - 3 * ROW_PX) {
        this.box.scrollTop = Math.max(0, top - this.box.clientHeight / 3)
      }
    }
    this.draw()
  }

  key(event) {
    const page = Math.max(1, Math.floor(this.box.clientHeight / ROW_PX) - 2)
    const steps = { ArrowDown: 1, ArrowUp: -1, PageDown: page, PageUp: -page, Home: -Infinity, End: Infinity }
    if (!(event.key in steps) || !this.rows.length || event.target !== this.box) return
    event.preventDefault()
    const from = this.rows.indexOf(this.active)
    const to = Math.min(this.rows.length - 1, Math.max(0, (from < 0 && steps[event.key] > 0 ? -1 : from) + steps[event.key]))
    this.choose(this.rows[to])
    this.reveal(this.rows[to])
  }

  copy(target) {
    const line = (cells) => cells.map(quoted).join(",")
    const header = this.columns.map((c) => (c.unit ? `${c.name} [${c.unit}]` : c.name))
    const rows = Array.from(this.rows, (k) => line(this.columns.map((c) => cell(c.value(k)))))
    copyText([line(header), ...rows].join("\n") + "\n").then(() => {
      const words = target.textContent
      target.textContent = `${this.rows.length} rows copied`
      setTimeout(() => (target.textContent = words), 1500)
    })
  }
}

function cell(value) {
  if (typeof value !== "number") return value
  return Number.isFinite(value) ? String(Number(value.toPrecision(12))) : ""
}

/** A cell of CSV, quoted so that a spreadsheet does not read a name as a formula. */
function quoted(text) {
  const safe = /^[=+\-@\t\r]/.test(text) && Number.isNaN(Number(text)) ? `'${text}` : text
  return /[",\n\r]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe
}

function spacer(rows, columns) {
  const cell = make("td", { colSpan: columns })
  cell.style.height = `${rows * ROW_PX}px`
  return make("tr", { className: "v-space", "aria-hidden": "true" }, cell)
}

function filterHint(columns) {
  const number = columns.find((column) => column.words)
  return number ? `name, or ${number.key} > 3` : "name"
}

/** The test for rows to show, from texts to contain and comparisons of columns; null if it cannot be read. */
function condition(text, columns) {
  const tests = []
  const rest = text.replace(/([^\s<>=]+)\s*(<=|>=|<|>|=)\s*(\S+)/g, (_, key, sign, value) => {
    const column = columns.find((c) => c.words && c.key.toLowerCase() === key.toLowerCase())
    const number = Number(value)
    tests.push(column && !Number.isNaN(number) ? { column, sign, number } : null)
    return " "
  })
  if (tests.includes(null)) return null
  const words = rest.toLowerCase().split(/\s+/).filter(Boolean)
  const names = columns.filter((column) => !column.words)
  const compare = { "<": (a, b) => a < b, ">": (a, b) => a > b, "<=": (a, b) => a <= b, ">=": (a, b) => a >= b, "=": (a, b) => a === b }
  return (k) =>
    tests.every(({ column, sign, number }) => compare[sign](column.value(k), number)) &&
    words.every((word) => names.some((column) => column.value(k).toLowerCase().includes(word)))
}
