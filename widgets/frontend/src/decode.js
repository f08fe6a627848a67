// What widgets/wire.py wrote: a header and typed arrays, raw (live) or packed (page).

const TYPES = {
  uint8: Uint8Array, int8: Int8Array, uint16: Uint16Array, int16: Int16Array, uint32: Uint32Array, int32: Int32Array,
};
const UNSIGNED = { 1: Uint8Array, 2: Uint16Array, 4: Uint32Array };

const count = (shape) => shape.reduce((a, b) => a * b, 1);

/** A DataView, ArrayBuffer or typed array -> the bytes, copied so that any type may be laid over them. */
export function bytesOf(buffer) {
  if (buffer instanceof ArrayBuffer) return new Uint8Array(buffer.slice(0));
  return new Uint8Array(buffer.buffer.slice(buffer.byteOffset, buffer.byteOffset + buffer.byteLength));
}

/** Bytes -> the typed array that the header describes. */
export function typed(entry, bytes) {
  return new TYPES[entry.type](bytes.buffer, bytes.byteOffset, bytes.byteLength / TYPES[entry.type].BYTES_PER_ELEMENT);
}

/** base64 of a deflated blob -> bytes. */
export async function inflate(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** The arrays of a packed scene. */
export function unpack(header, blob) {
  const arrays = {};
  let offset = 0;
  for (const [key, entry] of Object.entries(header.arrays)) {
    const Type = TYPES[entry.type], size = Type.BYTES_PER_ELEMENT, length = count(entry.shape);
    const bytes = blob.subarray(offset, offset + length * size);
    offset += length * size;
    if (entry.coding === "plain") arrays[key] = new Type(bytes.slice().buffer);
    else {
      const small = unzigzag(joinPlanes(bytes, size, length));
      if (entry.coding === "moves") arrays[key] = restoreMoves(small, entry.shape, arrays[entry.tree]);
      else arrays[key] = new Type(restoreDifferences(small, entry.shape).buffer);
    }
  }
  return arrays;
}

function joinPlanes(bytes, size, length) {
  const whole = new UNSIGNED[size](length);
  for (let plane = 0; plane < size; plane++) {
    const shift = 8 * plane, start = plane * length;
    for (let i = 0; i < length; i++) whole[i] |= bytes[start + i] << shift;
  }
  return whole;
}

function unzigzag(array) {
  for (let i = 0; i < array.length; i++) array[i] = (array[i] >>> 1) ^ -(array[i] & 1);
  return array;
}

function restoreDifferences(array, shape) {
  const row = count(shape.slice(1));
  for (let i = row; i < array.length; i++) array[i] += array[i - row];
  return array;
}

/** small is (C,N,T); out is (T,N,C): moved like the neighbour in the tree, from where it was in the frame before. */
function restoreMoves(small, [T, N, C], tree) {
  const out = new Uint16Array(T * N * C);
  const moved = new Uint16Array(N);
  for (let c = 0; c < C; c++) {
    for (let t = 0; t < T; t++) {
      const at = t * N * C + c, before = at - N * C;
      for (let k = 0; k < tree.length; k += 2) {
        const vertex = tree[k], parent = tree[k + 1];
        moved[vertex] = small[(c * N + vertex) * T + t] + (parent < 0 ? 0 : moved[parent]);
        out[at + vertex * C] = moved[vertex] + (t ? out[before + vertex * C] : 0);
      }
    }
  }
  return out;
}
