// Read a log by its index and, with every checksum, from start to end; print what both have found as JSON.
import { readFile } from "node:fs/promises";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { loadDecompressHandlers, protobufFromBinaryDescriptor } from "@mcap/support";

const data = await readFile(process.argv[2]);
const decompressHandlers = await loadDecompressHandlers();
const readable = {
  size: async () => BigInt(data.length),
  read: async (offset, size) => data.subarray(Number(offset), Number(offset + size)),
};

const stream = new McapStreamReader({ decompressHandlers, validateCrcs: true });
stream.append(data);
const streamed = {};
const topics = new Map();
for (let record; (record = stream.nextRecord()) !== undefined; ) {
  if (record.type === "Channel") topics.set(record.id, record.topic);
  if (record.type === "Message") {
    const topic = topics.get(record.channelId);
    streamed[topic] = (streamed[topic] ?? 0) + 1;
  }
}

const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
const indexed = {};
const first = {};
const parsers = new Map();
for (const [id, channel] of reader.channelsById) {
  const schema = reader.schemasById.get(channel.schemaId);
  parsers.set(id, protobufFromBinaryDescriptor(schema.data).lookupType(schema.name));
}
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const { topic } = reader.channelsById.get(message.channelId);
  indexed[topic] = (indexed[topic] ?? 0) + 1;
  const fields = parsers.get(message.channelId).decode(message.data);
  first[topic] ??= fields.toJSON();
}
const metadata = {};
for await (const entry of reader.readMetadata()) metadata[entry.name] = Object.fromEntries(entry.metadata);
console.log(JSON.stringify({ done: stream.done(), streamed, indexed, first, metadata }));
