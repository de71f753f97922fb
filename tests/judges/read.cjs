// Reads a recording with @mcap/core's indexed reader and decodes every message with @foxglove/rosmsg2-serialization,
// as Foxglove and Lichtblick do. One JSON line a message, in the reader's order; 64-bit integers keep their digits.
"use strict";
const { open } = require("node:fs/promises");
const { McapIndexedReader } = require("@mcap/core");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const fzstd = require("fzstd");

function json(value) {
  if (typeof value === "bigint") return value.toString();
  if (typeof value === "number") return String(value); // NaN and Infinity as Python reads them
  if (typeof value === "string" || typeof value === "boolean") return JSON.stringify(value);
  if (Array.isArray(value) || ArrayBuffer.isView(value)) return "[" + Array.from(value, json).join(",") + "]";
  const entries = Object.entries(value).map(([key, inner]) => JSON.stringify(key) + ":" + json(inner));
  return "{" + entries.join(",") + "}";
}

async function main(path) {
  const file = await open(path, "r");
  const size = BigInt((await file.stat()).size);
  const readable = {
    size: async () => size,
    read: async (offset, length) => {
      const buffer = new Uint8Array(Number(length));
      const { bytesRead } = await file.read(buffer, 0, buffer.length, Number(offset));
      if (bytesRead !== buffer.length) throw new Error(`read of ${length} bytes at ${offset} gave ${bytesRead}`);
      return buffer;
    },
  };
  const decompressHandlers = { zstd: (data, length) => fzstd.decompress(data, new Uint8Array(Number(length))) };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const decoders = new Map();
  for await (const message of reader.readMessages()) {
    const channel = reader.channelsById.get(message.channelId);
    if (!decoders.has(channel.id)) {
      const schema = reader.schemasById.get(channel.schemaId);
      const definition = parse(new TextDecoder().decode(schema.data), { ros2: true });
      decoders.set(channel.id, new MessageReader(definition));
    }
    const data = decoders.get(channel.id).readMessage(message.data);
    const { logTime, publishTime, sequence } = message;
    process.stdout.write(json({ topic: channel.topic, logTime, publishTime, sequence, data }) + "\n");
  }
  await file.close();
}

main(process.argv[2]).catch((error) => {
  console.error(String(error));
  process.exitCode = 1;
});
