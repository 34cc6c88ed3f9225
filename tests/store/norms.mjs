// Print a norm or a distance from the fields of a store: node norms.mjs STORE ORDER MESH [OTHER]
import { access, readFile } from "node:fs/promises";
import { join } from "node:path";
import * as zarr from "zarrita";

const [folder, order, ...labels] = process.argv.slice(2);

// zarrita has no complex numbers: each is read as two real ones, which doubles the last axis.
const store = {
  async get(key) {
    const bytes = await readFile(join(folder, key)).catch(() => undefined);
    if (!bytes || !key.endsWith("zarr.json")) return bytes;
    const metadata = JSON.parse(bytes);
    const real = { complex64: "float32", complex128: "float64" }[metadata.data_type];
    if (real) {
      const chunk = metadata.chunk_grid.configuration.chunk_shape;
      metadata.shape.push(2 * metadata.shape.pop());
      chunk.push(2 * chunk.pop());
      Object.assign(metadata, { data_type: real, fill_value: "NaN" });
    }
    return new TextEncoder().encode(JSON.stringify(metadata));
  },
};

async function read(name, selection = null) {
  const array = await zarr.open.v3(zarr.root(store).resolve(name), { kind: "array" });
  return (await zarr.get(array, selection)).data;
}

const names = [...(await read("fourier/mesh"))];
const rows = labels.map((label) => names.indexOf(label));
const axes = ["x", "y", "z"];

// |a|² or |a - b|² of a sample.
const squared = (fields, sample) =>
  [2 * sample, 2 * sample + 1].reduce((sum, i) => sum + (fields[0][i] - (fields[1]?.[i] ?? 0)) ** 2, 0);

const fields = await Promise.all(rows.map((row) => read("fourier/fourier", [row, null, null, null])));
const [x, y, z] = await Promise.all(axes.map((axis) => read(`fourier/xi_${axis}`)));
const [wx, wy, wz] = await Promise.all(axes.map((axis) => read(`fourier/weight_${axis}`)));
const shells = await read("fourier/weight_shell");
let total = 0;
let sample = 0;
for (let i = 0; i < x.length; i++)
  for (let j = 0; j < y.length; j++)
    for (let k = 0; k < z.length; k++) {
      const square = x[i] ** 2 + y[j] ** 2 + z[k] ** 2;
      const weight = wx[i] * wy[j] * wz[k] * shells[Math.round(square / z[1] ** 2)];
      total += weight * (1 + square) ** order * squared(fields, sample++);
    }

const hasOctaves = await access(join(folder, "octaves")).then(() => true, () => false);
if (hasOctaves) {
  const octaves = await Promise.all(rows.map((row) => read("octaves/octaves", [row, null])));
  const [ox, oy, oz] = await Promise.all(axes.map((axis) => read(`octaves/xi_${axis}`)));
  const weights = await read("octaves/weight");
  weights.forEach((weight, i) => {
    total += weight * (1 + ox[i] ** 2 + oy[i] ** 2 + oz[i] ** 2) ** order * squared(octaves, i);
  });
}
console.log(Math.sqrt(total));
