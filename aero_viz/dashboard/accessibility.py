"""What viser's page lacks for screen readers, fingers and large text."""

from __future__ import annotations

NAMES = """
if (!window.aeroNames) {
  window.aeroNames = true;
  const icons = [["Slider-thumb", ""], ["list-search", "Search commands"], ["adjustments", "Settings of the page"],
                 ["tabler-icon-x", "Close"], ["share", "Share"]];
  const isNamed = e => e.labels?.length || e.ariaLabel || e.getAttribute("aria-labelledby") || e.innerText?.trim();
  const give = (e, name) => { if (name && !isNamed(e)) e.ariaLabel = name; };
  const nameAll = () => {
    let last = "";
    for (const label of document.querySelectorAll("label[for]")) {
      const row = label.closest(".mantine-Flex-root");
      if (!row || label.closest(".mantine-Input-wrapper")) continue;
      last = label.innerText.trim() || last;  // a slider below a number has no label of its own
      const fields = [...row.querySelectorAll("input:not([type=hidden]), [role=slider], [role=combobox], textarea")];
      const numbers = fields.filter(e => e.matches(".mantine-NumberInput-input"));
      const axes = numbers.length > 1 ? ["x", "y", "z", "w"] : [""];
      for (const e of fields) give(e, `${last} ${axes[numbers.indexOf(e)] ?? ""}`.trim());
    }
    for (const e of document.querySelectorAll("button:not([aria-label])")) {
      if (isNamed(e)) continue;
      const icon = e.querySelector("svg")?.getAttribute("class") ?? "";
      const known = icons.find(([part]) => icon.includes(part));
      give(e, known?.[1] || (e.matches(".mantine-Notification-closeButton, .mantine-CloseButton-root") ? "Close" : ""));
    }
  };
  let due = null;
  new MutationObserver(() => due ??= setTimeout(() => { due = null; nameAll(); }, 250))
    .observe(document.body, {subtree: true, childList: true});
  nameAll();
}
"""
"""Script that gives a name to every control without one, as it appears: that of its row, or of its icon."""

STYLE = "".join(
    (
        # A finger needs 40 px.
        "@media(pointer:coarse){",
        ":is(.mantine-Button-root,.mantine-ActionIcon-root,.mantine-CloseButton-root,[role=tab],"
        ".mantine-Select-input,.mantine-TextInput-input,.mantine-NumberInput-input)",
        "{min-height:40px!important;min-width:40px!important;height:auto!important}",
        ".mantine-NumberInput-controls{display:none!important}.mantine-NumberInput-input{padding-right:.5em!important}",
        ".mantine-ScrollArea-scrollbar{display:none!important}",  # it lies over the controls; a finger drags them
        # The border takes the finger and shows nothing.
        ".mantine-Checkbox-root:has(input),.mantine-Checkbox-inner,.mantine-Checkbox-input"
        "{width:40px!important;height:40px!important}",
        ".mantine-Checkbox-input{border:9px solid transparent!important;background-clip:padding-box!important;"
        "box-shadow:inset 0 0 0 1px var(--mantine-color-dimmed)}",
        ".mantine-Checkbox-icon{inset:9px!important;margin:auto}",
        ".mantine-Slider-root{padding-block:14px!important}"
        '.mantine-Slider-thumb::after{content:"";position:absolute;inset:-21px -3px}',
        ".mantine-ScrollArea-content [role=tab]{padding:0 .55em!important;min-height:40px!important}"
        ".mantine-ScrollArea-content div:has(>[role=tab]){margin-top:6px}}",
        # Where a window is low, as with large text, everything scrolls together.
        "@media(max-height:34em){.mantine-ScrollArea-content div:has(>[role=tab])+div"
        "{max-height:none!important;overflow:visible!important}}",
    )
)
"""Style sheet for fingers, and for windows in which little text has room."""
