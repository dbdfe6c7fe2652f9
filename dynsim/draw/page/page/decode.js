"use strict";
// Data of the page: from base64 and gzip to a head and tables of numbers; see dynsim/draw/page/content.py.
const D = {};

D.unpack = async function (text) {
  const packed = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
  if (typeof DecompressionStream === "undefined") throw new Error("this browser is too old (no DecompressionStream); use a newer one");
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const size = new DataView(bytes.buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + size)));
  return { head, bytes: bytes.subarray(4 + size) };
};

// Table: columns of numbers over rows, decoded on first use.
D.Table = class {
  constructor(bytes, block) {
    this.bytes = bytes;
    this.block = block;
    this.rows = block.rows;
    this.columns = block.columns;
    this.cache = new Array(block.columns);
  }

  column(k) {
    if (this.cache[k]) return this.cache[k];
    const { at, bits, columns, offset, scale } = this.block, rows = this.rows;
    const count = rows * columns, planes = bits / 8, none = bits === 16 ? 0xffff : 0xffffffff;
    const values = new Float64Array(rows);
    let code = 0;
    for (let i = 0; i < rows; i++) {
      let step = 0;
      for (let b = planes - 1; b >= 0; b--) step = step * 256 + this.bytes[at + b * count + k * rows + i];
      code += step;
      if (code > none) code -= none + 1;
      values[i] = code === none ? NaN : offset[k] + scale[k] * code;
    }
    return (this.cache[k] = values);
  }

  value(row, k) {
    return this.column(k)[row];
  }
};

// Last index whose value is not beyond t, within [0, n - 2] so that there is a next index.
D.before = function (times, t) {
  let low = 0, high = times.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle;
    else high = middle;
  }
  return low;
};

D.percentile = function (values, share) {
  const known = Array.from(values).filter(Number.isFinite).sort((a, b) => a - b);
  return known.length ? known[Math.min(known.length - 1, Math.floor(share * known.length))] : 0;
};

D.number = function (x, digits = 4) {
  if (x === null || x === undefined || !Number.isFinite(x)) return "–";
  if (x === 0) return "0";
  const size = Math.abs(x);
  const round = Number(x.toPrecision(digits));
  const text = size >= 1e5 || size < 1e-3 ? Number(x.toPrecision(3)).toExponential() : String(round);
  return text.replace("-", "−").replace("e+", "e");
};

D.element = function (tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
};

// Colours of Okabe and Ito; lighter on a dark background.
D.palette = {
  light: { push: "#0072B2", pull: "#D55E00", friction: "#7A3E9D", target: "#000000", hand: "#0072B2", slip: "#E69F00",
    stick: "#009E73", open: "#7F7F7F", support: "#56B4E9", body: "#AEB7C4", hub: "#4A5260", wheel: "#3A4048", down: "#0072B2",
    lifted: "#FFFFFF", ground: "#EEF0F3", gridline: "#B9C0CA", solid: "#B0BCC9", edge: "#6C7B8C", fog: "#F7F8FA", pad: "#3A4048", saturated: "#D55E00", sunk: "#882255", tool: "#3A4048" },
  dark: { push: "#56B4E9", pull: "#FF7438", friction: "#D9A5E8", target: "#FFFFFF", hand: "#56B4E9", slip: "#F0E442",
    stick: "#2BC79B", open: "#9AA3AD", support: "#56B4E9", body: "#98A2B0", hub: "#67717F", wheel: "#7C8794", down: "#56B4E9",
    lifted: "#FFFFFF", ground: "#1D2126", gridline: "#3B434D", solid: "#46515E", edge: "#8593A3", fog: "#15181C", pad: "#D5DAE0", saturated: "#FF7438", sunk: "#F28AB8", tool: "#D5DAE0" },
};
D.variants = { light: ["#0072B2", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#332288", "#8C6D31"],
  dark: ["#56B4E9", "#2BC79B", "#F0B429", "#E59BC4", "#9AD4F5", "#B7B1F2", "#C9A86A"] };
