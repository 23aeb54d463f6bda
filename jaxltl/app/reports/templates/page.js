"use strict";
// An explorer shows a policy for one memory state, and plays trajectories on map and automaton.
(() => {
  const CELL = 40, PAUSE = 600;
  document.documentElement.classList.add("live");
  const all = JSON.parse(document.getElementById("data").textContent);

  const percent = (x) => x === null ? "unknown" : x >= 0.00095 || x === 0 ? x.toFixed(4)
    : x.toExponential(1);

  function explore(root, data) {
    const one = (query) => root.querySelector(query);
    const every = (query) => [...root.querySelectorAll(query)];
    const map = one("svg.map"), tokens = every(".token"), cursor = one(".cursor");
    const readout = one(".readout"), slider = one("input[type=range]");
    const select = one("select"), play = one(".play");
    let key = data.first, cell = null, timer = null, started = false;

    const place = (state) => data.places[state] ? data.places[state]
      : data.columns === null ? `state ${state}`
      : `row ${Math.floor(state / data.columns) + 1}, column ${state % data.columns + 1}`;

    const show = (element, visible) => { element.style.display = visible ? "" : "none"; };

    // Scrolls a wide picture so that a part of it is centred.
    function center(part) {
      const frame = part.closest(".scroll"), at = part.getBoundingClientRect();
      const around = frame.getBoundingClientRect();
      frame.scrollLeft += at.left + at.width / 2 - around.left - around.width / 2;
    }

    function say(text) { readout.textContent = text; }

    function choose(next) {
      key = String(next);
      for (const element of every("[aria-pressed][data-memory]")) {
        element.setAttribute("aria-pressed", element.dataset.memory === key);
      }
      const chosen = one(".state[aria-pressed=true]");
      if (chosen) center(chosen);
      for (const query of [".layer", ".marked", "table[data-memory]"]) {
        for (const element of every(query)) show(element, element.dataset.memory === key);
      }
      const layer = data.layers[key], scale = one(".scale");
      if (scale) show(scale, Boolean(layer && layer.value));
      one(".memory").textContent = data.memories[key] ?? "";
      if (cell !== null) describe(cell);
    }

    function describe(state) {
      const layer = data.layers[key], parts = [place(state)];
      if (layer && layer.value && layer.value[state] !== null) {
        parts.push(`${data.label} ${percent(layer.value[state])}`);
      }
      const row = layer && layer.policy && layer.policy[state];
      if (row && row[0] !== null) {
        const moves = row.map((x, a) => [x, data.actions[a]]).filter(([x]) => x >= 0.0005);
        moves.sort((a, b) => b[0] - a[0]);
        parts.push(moves.map(([x, name]) => `${name} ${x.toFixed(3)}`).join(", "));
      } else if (data.first !== null && (!layer || layer.value === null || layer.value[state] === null)) {
        parts.push("no values here");
      }
      say(parts.join(" · "));
    }

    function point(state) {
      cell = state;
      cursor.style.visibility = "visible";
      cursor.setAttribute("x", state % data.columns * CELL);
      cursor.setAttribute("y", Math.floor(state / data.columns) * CELL);
      describe(state);
    }

    function under(event) {
      const at = new DOMPoint(event.clientX, event.clientY)
        .matrixTransform(map.getScreenCTM().inverse());
      const row = Math.floor(at.y / CELL), column = Math.floor(at.x / CELL);
      if (row < 0 || column < 0 || row >= data.rows || column >= data.columns) return null;
      return row * data.columns + column;
    }

    function stop() {
      clearInterval(timer);
      timer = null;
      play.textContent = "Play";
      play.setAttribute("aria-pressed", "false");
      quiet(false);
    }

    // Screen readers do not read a playing trajectory; its steps are in the table.
    function quiet(on) {
      for (const region of [readout, one(".memory")]) {
        region.setAttribute("aria-live", on ? "off" : "polite");
      }
    }

    // Shades cells by the belief of a step, and frames the window of cells that the robot sees.
    function believe(belief, at) {
      const shades = one(".belief"), frame = one(".window");
      root.classList.toggle("believing", belief !== null);
      if (!shades) return;
      shades.replaceChildren();
      frame.style.visibility = belief === null ? "hidden" : "visible";
      if (belief === null) return;
      const half = (data.window - 1) / 2;
      frame.setAttribute("x", (at % data.columns - half) * CELL);
      frame.setAttribute("y", (Math.floor(at / data.columns) - half) * CELL);
      for (const [state, chance] of belief) {
        const rect = document.createElementNS(shades.namespaceURI, "rect");
        rect.setAttribute("x", state % data.columns * CELL);
        rect.setAttribute("y", Math.floor(state / data.columns) * CELL);
        rect.setAttribute("width", CELL);
        rect.setAttribute("height", CELL);
        rect.setAttribute("fill-opacity", 0.12 + 0.78 * chance);
        shades.append(rect);
      }
    }

    // Shows step t of the selected trajectory on map and automaton, and as text.
    function step(t) {
      const run = data.runs[Number(select.value)], [state, memory, action] = run.steps[t];
      started = true;
      slider.max = run.steps.length - 1;
      slider.value = t;
      const did = action === null ? "end" : `action ${data.actions[action]}`;
      const belief = run.beliefs ? run.beliefs[t] : null;
      const parts = [place(state), ...(data.memories[memory] ? [`memory state ${memory}`] : []), did];
      if (belief !== null) {
        const likely = belief.slice(0, 3).map(([s, p]) => `${place(s)} ${percent(p)}`);
        parts.splice(1, 0, `sees observation ${run.observations[t]}`);
        parts.push(`believes: ${likely.join("; ")}${belief.length > 3 ? "; …" : ""}`);
      }
      const text = `step ${t} of ${run.steps.length - 1}: ${parts.join(" · ")}`;
      slider.setAttribute("aria-valuetext", text);
      cell = null;
      choose(memory);
      if (map) believe(belief, state);
      if (cursor) cursor.style.visibility = "hidden";
      tokens.forEach((token, i) => {
        const at = data.cells[state] ? data.cells[state][i] : state;
        const x = (at % data.columns + 0.5) * CELL;
        const y = (Math.floor(at / data.columns) + 0.5) * CELL;
        // Moves smoothly between steps, except at its first position.
        token.style.transition = token.style.visibility === "visible" ? "" : "none";
        token.style.visibility = "visible";
        token.style.transform = `translate(${x}px, ${y}px)`;
        if (i === 0) center(token);
      });
      const before = t > 0 ? run.steps[t - 1][1] : null;
      for (const edge of every(".edge")) {
        edge.classList.toggle("taken", before !== null && before !== memory
          && Number(edge.dataset.from) === before && Number(edge.dataset.to) === memory);
      }
      for (const track of every(".track")) show(track, track.dataset.run === select.value);
      for (const table of every("table[data-run]")) {
        show(table, table.dataset.run === select.value);
        [...table.tBodies[0].rows].forEach((row, i) => {
          if (i === t) row.setAttribute("aria-current", "step");
          else row.removeAttribute("aria-current");
        });
      }
      say(`${run.name}, ${text}`);
    }

    for (const element of every("[aria-pressed][data-memory]")) {
      const chosen = () => { stop(); believe(null, 0); choose(element.dataset.memory); };
      element.addEventListener("click", chosen);
      if (element.tagName !== "BUTTON") {
        element.addEventListener("keydown", (event) => {
          if (event.key !== "Enter" && event.key !== " ") return;
          event.preventDefault();
          chosen();
        });
      }
    }
    if (map) {
      map.addEventListener("pointermove", (event) => {
        const state = timer === null ? under(event) : null;
        if (state !== null && state !== cell) point(state);
      });
      map.addEventListener("click", (event) => {
        const state = under(event);
        if (state !== null) { stop(); believe(null, 0); point(state); }
      });
      one(".board").addEventListener("keydown", (event) => {
        const by = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
        if (!(event.key in by)) return;
        event.preventDefault();
        stop();
        if (cell === null) return point(0);
        const row = Math.floor(cell / data.columns) + by[event.key][0];
        const column = cell % data.columns + by[event.key][1];
        if (row >= 0 && column >= 0 && row < data.rows && column < data.columns) {
          point(row * data.columns + column);
        }
      });
    }
    if (select) {
      select.addEventListener("change", () => { stop(); step(0); });
      slider.addEventListener("input", () => { stop(); step(Number(slider.value)); });
      one(".back").addEventListener("click", () => {
        stop();
        step(Math.max(0, Number(slider.value) - 1));
      });
      one(".on").addEventListener("click", () => {
        stop();
        step(Math.min(Number(slider.max), Number(slider.value) + 1));
      });
      play.addEventListener("click", () => {
        if (timer !== null) return stop();
        const run = data.runs[Number(select.value)];
        step(started && Number(slider.value) < run.steps.length - 1 ? Number(slider.value) : 0);
        play.textContent = "Pause";
        play.setAttribute("aria-pressed", "true");
        quiet(true);
        timer = setInterval(() => {
          const next = Number(slider.value) + 1;
          if (next > Number(slider.max)) return stop();
          return step(next);
        }, PAUSE);
      });
      slider.max = data.runs[0].steps.length - 1;
      for (const table of every("table[data-run]")) show(table, table.dataset.run === "0");
    }
    choose(key);
  }

  // Marks the sides of a frame to which it scrolls.
  function sides(frame) {
    const rest = frame.scrollWidth - frame.clientWidth - frame.scrollLeft;
    frame.classList.toggle("before", frame.scrollLeft > 1);
    frame.classList.toggle("after", rest > 1);
  }

  // Scrollable frames are focusable while they scroll.
  function reach() {
    for (const frame of document.querySelectorAll(".scroll")) {
      sides(frame);
      if (frame.classList.contains("board")) continue;
      if (frame.scrollWidth > frame.clientWidth) frame.tabIndex = 0;
      else frame.removeAttribute("tabindex");
    }
  }
  for (const frame of document.querySelectorAll(".scroll")) {
    frame.addEventListener("scroll", () => sides(frame), { passive: true });
    frame.insertAdjacentHTML("afterend",
      '<p class="sideways" aria-hidden="true">← scrolls sideways →</p>');
  }
  addEventListener("resize", reach);
  for (const fold of document.querySelectorAll("details")) fold.addEventListener("toggle", reach);
  reach();

  for (const data of all) explore(document.getElementById(data.name), data);
})();
