// Controls from the fields that the server describes: one row for each number.

const CHANNELS = ["red", "green", "blue"];

/** `ρ_d` as an element with its index below the line. */
export function symbol(text) {
  const [letter, index] = text.split("_");
  const element = make("var", {}, letter);
  if (index) element.append(make("sub", {}, index));
  return element;
}

/** An element with properties and children. */
export function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

/**
 * A panel of controls. Fields go to the element of `root` that has their group.
 *
 * `changed(name)` is called after the user has moved something.
 */
export class Panel {
  #fields;
  #widgets = {};

  constructor(root, fields, changed) {
    this.#fields = fields;
    this.values = {};
    for (const [name, field] of Object.entries(fields)) {
      const place = root.querySelector(`[data-group="${field.group}"]`);
      if (!place) continue;
      const moved = (value) => {
        this.values[name] = value;
        this.#showRelevant();
        changed(name);
      };
      const widget = kindOf(field)(name, field, moved);
      this.#widgets[name] = widget;
      place.append(widget.element);
    }
    this.reset();
  }

  /** Take over some values, as near as the limits allow. */
  set(values) {
    for (const [name, value] of Object.entries(values)) {
      this.values[name] = within(this.#fields[name], value);
      this.#widgets[name]?.show(this.values[name]);
    }
    this.#showRelevant();
  }

  /** All defaults again, but for the fields in `except`. */
  reset(except = []) {
    const kept = Object.entries(this.#fields).filter(([name]) => !except.includes(name));
    this.set(Object.fromEntries(kept.map(([name, field]) => [name, field.default])));
  }

  /** Hide what does nothing at the present values. */
  #showRelevant() {
    for (const [name, widget] of Object.entries(this.#widgets)) {
      const only = Object.entries(this.#fields[name].only ?? {});
      widget.element.hidden = !only.every(([other, values]) =>
        values.includes(this.values[other]));
    }
  }
}

function kindOf(field) {
  if (field.type === "boolean") return checkbox;
  if (field.type === "array") return colour;
  if (field.enum) return field.enum.length > 4 ? menu : choice;
  return number;
}

function within(field, value) {
  if (field.type === "array") return value.map((one, k) => within(field.prefixItems[k], one));
  if (field.type !== "number") return value;
  return Math.min(Math.max(value, field.minimum), field.maximum);
}

function caption(field) {
  const parts = field.symbol ? [symbol(field.symbol), " ", field.title] : [field.title];
  return make("span", {}, ...parts);
}

function word(field, value) {
  return field.words?.[value] ?? value;
}

function checkbox(name, field, moved) {
  const input = make("input", { type: "checkbox", name });
  input.addEventListener("change", () => moved(input.checked));
  const element = make("label", { className: "row check" }, input, caption(field));
  return { element, show: (value) => { input.checked = value; } };
}

function menu(name, field, moved) {
  const options = field.enum.map((value) => make("option", { value }, word(field, value)));
  const select = make("select", { name }, ...options);
  select.addEventListener("change", () => moved(select.value));
  const element = make("label", { className: "row" }, caption(field), select);
  return { element, show: (value) => { select.value = value; } };
}

function choice(name, field, moved) {
  const inputs = field.enum.map((value) => make("input", { type: "radio", name, value }));
  for (const input of inputs) input.addEventListener("change", () => moved(input.value));
  const labels = inputs.map((input) => make("label", {}, input, word(field, input.value)));
  const group = make("span", { className: "choice" }, ...labels);
  group.setAttribute("role", "radiogroup");
  group.setAttribute("aria-label", field.title);
  // Four fill the line, and say themselves what they are.
  const words = inputs.length > 3 ? [] : [caption(field)];
  const element = make("div", { className: "row" }, ...words, group);
  return { element, show: (value) => inputs.forEach((i) => { i.checked = i.value === value; }) };
}

function number(name, field, moved) {
  const { inputs, show } = slider(name, field.title, field, field, moved);
  const unit = make("small", {}, field.unit ?? "");
  const element = make("div", { className: "slider" }, caption(field), ...inputs, unit);
  return { element, show };
}

/** Three sliders, which keep their ratios while they are tied together. */
function colour(name, field, moved) {
  let values = [...field.default];
  const together = make("input", { type: "checkbox", checked: true });
  const sliders = CHANNELS.map((channel, k) => slider(
    `${name}.${channel}`, `${field.title}, ${channel}`, field.prefixItems[k], field,
    (value) => { values = together.checked ? scaled(k, value) : values.with(k, value); show(values); moved(values); },
  ));

  function scaled(k, value) {
    const { maximum } = field.prefixItems[k];
    if (values[k] === 0) return values.map(() => value);
    const factor = Math.min(value / values[k], maximum / Math.max(...values));
    return values.map((old) => old * factor);
  }

  function show(shown) {
    values = [...shown];
    sliders.forEach((one, k) => one.show(values[k]));
  }

  const tie = make("label", { className: "tie" }, together, "move all three");
  const head = make("div", { className: "row" }, caption(field), tie);
  const rows = sliders.map((one, k) => make(
    "div", { className: `slider ${CHANNELS[k]}` },
    make("span", {}, CHANNELS[k][0].toUpperCase()), ...one.inputs, make("small"),
  ));
  return { element: make("div", { className: "colour" }, head, ...rows), show };
}

/** A range and a number that say the same. */
function slider(name, title, { minimum, maximum }, { step, scale, unit }, moved) {
  const log = scale === "log";
  const range = make("input", { type: "range", name, min: log ? 0 : minimum,
    max: log ? 1 : maximum, step: log ? 0.005 : step });
  const exact = make("input", { type: "number", min: minimum, max: maximum, step: "any" });
  range.setAttribute("aria-label", title);
  exact.setAttribute("aria-label", `${title}, as a number`);

  const place = (value) => Math.log(value / minimum) / Math.log(maximum / minimum);
  const value = () => log ? minimum * (maximum / minimum) ** range.valueAsNumber
    : range.valueAsNumber;

  function show(shown) {
    // As many digits as there is room for; the value itself keeps all of them.
    const text = String(Number(shown.toFixed(Math.abs(shown) < 10 ? 3 : 1)));
    range.value = log ? place(shown) : shown;
    range.setAttribute("aria-valuetext", unit ? `${text} ${unit}` : text);
    exact.value = text;
  }

  range.addEventListener("input", () => { const to = value(); show(to); moved(to); });
  exact.addEventListener("change", () => {
    const typed = Number.isFinite(exact.valueAsNumber) ? exact.valueAsNumber : value();
    const to = within({ type: "number", minimum, maximum }, typed);
    show(to);
    moved(to);
  });
  return { inputs: [range, exact], show };
}
