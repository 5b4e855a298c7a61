/** Digests of what the page's decoder makes of views, for comparison with Python's: node decode_views.ts FILE... */

import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { packed } from "../src/decode/pack.ts";
import { decodeView } from "../src/decode/view.ts";

const digest = (array: ArrayBufferView) =>
  createHash("sha256").update(new Uint8Array(array.buffer, array.byteOffset, array.byteLength)).digest("hex");

for (const path of process.argv.slice(2)) {
  try {
    const view = decodeView(new Uint8Array(readFileSync(path)));
    const { cell, depth, cellDepth, voxelEdgeUm, nodes, chances, coloured, rgb, warm, heats } = view;
    const arrays = { nodes, chances, coloured, rgb, warm, heats, packed: packed(view) };
    const digests = Object.fromEntries(Object.entries(arrays).map(([name, array]) => [name, digest(array)]));
    console.log(JSON.stringify({ cell, depth, cellDepth, voxelEdgeUm, ...digests }));
  } catch (error) {
    console.log(JSON.stringify({ error: String(error) }));
  }
}
