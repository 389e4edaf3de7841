// Elements of the page. Every text is set as text: names are data, never markup.

/** Return a new element with properties, listeners (on...), attributes (with a dash) and children. */
export function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag)
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value)
    else if (name.includes("-") || name === "role" || name === "for") element.setAttribute(name, value)
    else element[name] = value
  }
  element.append(...children.filter((child) => child !== null && child !== undefined))
  return element
}

export function button(text, onclick, properties = {}) {
  return make("button", { type: "button", onclick, ...properties }, text)
}

/** A labelled check box. */
export function tick(text, checked, onchange, properties = {}) {
  const box = make("input", { type: "checkbox", checked, ...properties })
  box.addEventListener("change", () => onchange(box.checked))
  return make("label", { className: "v-tick" }, box, text)
}

export function choice(text, options, onchange, properties = {}) {
  const select = make("select")
  for (const [value, words] of options) select.append(make("option", { value }, words))
  const { value = select.value, ...others } = properties // a select has no value before its options
  select.value = value
  for (const [name, one] of Object.entries(others)) select.setAttribute(name, one)
  select.addEventListener("change", () => onchange(select.value))
  return make("label", { className: "v-choice" }, `${text} `, select)
}

/** A table of two columns. */
export function facts(rows) {
  const body = rows
    .filter(Boolean)
    .map(([name, value]) => make("tr", {}, make("th", { scope: "row" }, name), make("td", {}, value)))
  return make("table", { className: "facts" }, make("tbody", {}, ...body))
}

/** Passes the events select and hover to their listeners. */
export class Hub {
  #listeners = new Map()

  on(event, listener) {
    this.#listeners.set(event, [...(this.#listeners.get(event) ?? []), listener])
  }

  tell(event, value) {
    for (const listener of this.#listeners.get(event) ?? []) listener(value)
  }
}

/** Copy a text to the clipboard, the older way where a page from a file has no access to it. */
export async function copyText(text) {
  try {
    await navigator.clipboard.writeText(text)
  } catch {
    const area = make("textarea", { value: text })
    document.body.append(area)
    area.select()
    document.execCommand("copy")
    area.remove()
  }
}
