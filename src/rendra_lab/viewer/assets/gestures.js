// Mouse, touch and keys. `actions` are the viewer's: turn, pan, zoom, focus, reset and toggles.

const WHEEL_STEP = 0.0015;  // of a zoom's logarithm for each pixel of the wheel
const ARROW_TURN = Math.PI / 36;
const DOUBLE_TAP = { ms: 320, px: 24 };

function listen(canvas, actions) {
  const fingers = new Map();
  let lastTap = { time: -Infinity, x: 0, y: 0 };
  let moved = 0;

  function spread() {
    const [a, b] = [...fingers.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, gap: Math.max(1, Math.hypot(a.x - b.x, a.y - b.y)) };
  }

  function drag(event, dx, dy) {
    const tall = canvas.clientHeight || 1;
    if (event.buttons & 6 || event.shiftKey) actions.pan(dx / tall, dy / tall);
    else actions.turn(Math.PI * dx / tall, Math.PI * dy / tall);
  }

  function down(event) {
    canvas.focus({ preventScroll: true });
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    moved = fingers.size > 1 ? Infinity : 0;
  }

  function move(event) {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY };
    moved += Math.hypot(now.x - before.x, now.y - before.y);
    if (fingers.size === 2) {
      const old = spread();
      fingers.set(event.pointerId, now);
      const fresh = spread(), tall = canvas.clientHeight || 1;
      actions.zoom(old.gap / fresh.gap);
      actions.pan((fresh.x - old.x) / tall, (fresh.y - old.y) / tall);
    } else {
      fingers.set(event.pointerId, now);
      if (fingers.size === 1) drag(event, now.x - before.x, now.y - before.y);
    }
  }

  function lift(event) {
    if (!fingers.delete(event.pointerId) || event.pointerType !== "touch" || moved > 8) return;
    const near = Math.hypot(event.clientX - lastTap.x, event.clientY - lastTap.y) < DOUBLE_TAP.px;
    if (near && event.timeStamp - lastTap.time < DOUBLE_TAP.ms) focusAt(event);
    lastTap = { time: event.timeStamp, x: event.clientX, y: event.clientY };
  }

  function focusAt(event) {
    const box = canvas.getBoundingClientRect();
    actions.focus((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
  }

  // In a page that scrolls, the wheel scrolls until somebody clicks here.
  function wheel(event) {
    const page = document.scrollingElement;
    const scrolls = page && page.scrollHeight > window.innerHeight + 1 && getComputedStyle(page).overflowY !== "hidden";
    if (scrolls && !event.ctrlKey && canvas.getRootNode().activeElement !== canvas) return;
    event.preventDefault();
    const pixels = event.deltaY * [1, 20, 400][event.deltaMode] * (event.ctrlKey ? 5 : 1);
    actions.zoom(Math.exp(clamp(pixels, -400, 400) * WHEEL_STEP));
  }

  function key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (arrow && event.shiftKey) actions.pan(arrow[0] * 0.05, arrow[1] * 0.05);
    else if (arrow) actions.turn(arrow[0] * ARROW_TURN, arrow[1] * ARROW_TURN);
    else if (event.key === "+" || event.key === "=") actions.zoom(0.85);
    else if (event.key === "-" || event.key === "_") actions.zoom(1 / 0.85);
    else if (event.key === "Escape") canvas.blur();
    else if (!actions.press(event.key.toLowerCase())) return;
    event.preventDefault();
  }

  const listeners = {
    pointerdown: down,
    pointermove: move,
    pointerup: lift,
    pointercancel: (event) => fingers.delete(event.pointerId),
    dblclick: focusAt,
    contextmenu: (event) => event.preventDefault(),
    keydown: key,
  };
  for (const [name, listener] of Object.entries(listeners)) canvas.addEventListener(name, listener);
  canvas.addEventListener("wheel", wheel, { passive: false });
}
