// Tables of a page: sorted by a click on the name of a column, filtered by text, copied as CSV. Without this
// script they are plain tables. Texts are set as text: names are data, never markup.
(() => {
  const MIN_ROWS = 6 // shorter tables are read at a glance
  const make = (tag, properties, ...children) => {
    const element = Object.assign(document.createElement(tag), properties)
    element.append(...children)
    return element
  }
  const text = (cell) => cell.textContent.trim().replace(/\s+/g, " ")
  const number = (shown) => {
    const plain = shown.replace("−", "-").replace(/[ ,](?=\d{3})/g, "")
    return /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?/i.test(plain) ? parseFloat(plain) : NaN
  }
  const quoted = (shown) => {
    const safe = /^[=+\-@]/.test(shown) && Number.isNaN(number(shown)) ? `'${shown}` : shown // no formula
    return /[",\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe
  }

  async function copy(content) {
    try {
      await navigator.clipboard.writeText(content)
    } catch {
      const area = make("textarea", { value: content })
      document.body.append(area)
      area.select()
      document.execCommand("copy")
      area.remove()
    }
  }

  function equip(table) {
    const heads = [...(table.tHead?.rows[0]?.cells ?? [])]
    const body = table.tBodies[0]
    const fits = (row) => [...row.cells].every((cell) => cell.colSpan === 1) && row.cells.length === heads.length
    const last = body ? [...body.rows].filter((row) => row.classList.contains("sum")) : []
    const rows = body ? [...body.rows].filter((row) => !row.classList.contains("sum")) : []
    const facts = heads.length === 0 || text(heads[0]) === "" // a list of facts, not of items of one kind
    if (facts || table.closest("#explore") || rows.length < MIN_ROWS || !rows.every(fits)) return

    heads.forEach((head, column) => {
      const sort = make("button", { type: "button", className: "sort", title: "sort by this column" }, ...head.childNodes)
      sort.addEventListener("click", () => {
        const down = head.getAttribute("aria-sort") === "ascending"
        for (const other of heads) other.removeAttribute("aria-sort")
        head.setAttribute("aria-sort", down ? "descending" : "ascending")
        const keys = new Map(rows.map((row) => [row, text(row.cells[column])]))
        const order = (one, other) => {
          const [a, b] = [number(keys.get(one)), number(keys.get(other))]
          if (Number.isNaN(a) !== Number.isNaN(b)) return Number.isNaN(a) ? 1 : -1 // texts come after numbers
          const sign = down ? -1 : 1
          return sign * (Number.isNaN(a) ? keys.get(one).localeCompare(keys.get(other), "en", { numeric: true }) : a - b)
        }
        body.append(...[...rows].sort(order), ...last)
      })
      head.replaceChildren(sort)
    })

    const count = make("span", { className: "count", textContent: `${rows.length} rows` })
    const filter = make("input", { type: "search", placeholder: "filter rows" })
    filter.setAttribute("aria-label", "filter rows")
    filter.addEventListener("input", () => {
      const wanted = filter.value.toLowerCase()
      for (const row of rows) row.hidden = !text(row).toLowerCase().includes(wanted)
      const left = rows.filter((row) => !row.hidden).length
      count.textContent = left < rows.length ? `${left} of ${rows.length} rows` : `${rows.length} rows`
    })
    const csv = make("button", { type: "button", textContent: "copy as CSV" })
    csv.addEventListener("click", async () => {
      const shown = [table.tHead.rows[0], ...body.rows].filter((row) => !row.hidden)
      await copy(shown.map((row) => [...row.cells].map((cell) => quoted(text(cell))).join(",") + "\n").join(""))
      csv.textContent = "copied"
    })
    const box = table.closest(".scroll") ?? table
    box.before(make("div", { className: "tools" }, filter, csv, count))
  }

  for (const table of document.querySelectorAll("main table")) equip(table)
})()
