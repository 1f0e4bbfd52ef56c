"""A page that believes that its tab is hidden: without a window, a browser cannot hide one."""

HIDE = """
(() => {
  // What a browser does in a hidden tab: no pictures.
  const draw = requestAnimationFrame.bind(window), held = [];
  let hidden = false;
  Object.defineProperty(document, "hidden", {get: () => hidden});
  window.requestAnimationFrame = callback => hidden ? held.push(callback) : draw(callback);
  window.hide = now => {
    hidden = now;
    if (!hidden) held.splice(0).forEach(callback => draw(callback));
  };
})()
"""
"""Script that runs before those of the page. `hide(true)` hides the page from then on, `hide(false)` shows it again."""
