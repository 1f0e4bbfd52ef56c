"""Number fields of the page: what is typed counts on Enter or when the field is left, and not letter by letter."""

LISTENER = r"""
if (!window.aeroNumbers) {
  window.aeroNumbers = true;
  const write = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set;
  const isField = target => target instanceof HTMLInputElement && target.matches(".mantine-NumberInput-input");
  let typed = null, before = "", isCommitted = false;
  const say = (field, text) => {
    document.querySelectorAll(".aero-not-taken").forEach(note => note.remove());
    if (!text) return;
    const note = document.createElement("div"), box = field.getBoundingClientRect();
    note.className = "aero-not-taken";
    note.setAttribute("role", "alert");
    note.textContent = text;
    note.style.top = `${box.bottom + 4}px`;
    note.style.right = `${Math.max(innerWidth - box.right, 8)}px`;
    document.body.append(note);
    setTimeout(() => note.remove(), 6000);
  };
  const restore = field => { typed = null; write.call(field, before); };
  const commit = field => {
    if (typed === null) return;
    const text = typed.trim();
    if (text === "" || !Number.isFinite(Number(text))) {
      restore(field);
      return say(field, `${text === "" ? "The field was empty" : `${text} is no number`}: ${before} stays.`);
    }
    write.call(field, text);
    typed = null;
    isCommitted = true;
    field.dispatchEvent(new Event("input", {bubbles: true}));
    isCommitted = false;
  };
  addEventListener("focusin", event => {
    if (isField(event.target)) { typed = null; before = event.target.value; }
  }, true);
  for (const kind of ["input", "change"]) addEventListener(kind, event => {
    if (!isField(event.target) || isCommitted) return;
    event.stopImmediatePropagation();
    if (kind !== "input") return;
    if (typed === null) before = event.target._valueTracker?.getValue() ?? before;  // what the page last showed
    typed = event.target.value;
    say(event.target, "");
  }, true);
  addEventListener("beforeinput", event => {
    if (isField(event.target) && typed !== null && event.target.value !== typed) write.call(event.target, typed);
  }, true);
  addEventListener("focusout", event => { if (isField(event.target)) commit(event.target); }, true);
  addEventListener("keydown", event => {
    if (!isField(event.target)) return;
    if (["Enter", "ArrowUp", "ArrowDown"].includes(event.key)) commit(event.target);
    if (event.key === "Escape" && typed !== null) restore(event.target);
  }, true);
}
"""
"""Script that keeps what is typed into a number field from the page until it counts.

A field that is left empty, or with something that is no number, shows its number again and says why. Escape gives up.
"""
