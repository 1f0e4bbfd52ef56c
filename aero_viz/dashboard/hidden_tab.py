"""A tab that nobody sees goes on reading: a browser draws no pictures there, and viser reads between two pictures."""

SCRIPT = """
if (!window.aeroHidden) {
  const draw = requestAnimationFrame.bind(window), cancel = cancelAnimationFrame.bind(window), waiting = new Map();
  let last = 1e9;
  const run = (id, time) => {
    const callback = waiting.get(id);
    waiting.delete(id);
    callback?.(time);
  };
  window.requestAnimationFrame = callback => {
    const id = ++last;
    waiting.set(id, callback);
    draw(time => run(id, time));
    return id;
  };
  window.cancelAnimationFrame = id => waiting.delete(id) || cancel(id);
  // A browser slows the timers of a hidden page down to one a minute, but not those of a worker.
  const code = URL.createObjectURL(new Blob(["setInterval(() => postMessage(0), 1000)"]));
  window.aeroHidden = new Worker(code);
  window.aeroHidden.onmessage = () => {
    if (document.hidden) [...waiting.keys()].forEach(id => run(id, performance.now()));
  };
}
"""
"""Script of every page. Without it, a flight of 50 ticks a second would fill a hidden tab with 2 MB a second."""
