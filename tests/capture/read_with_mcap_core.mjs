// Reads an MCAP file with @mcap/core, by its index and by streaming with CRCs checked, and prints what it found as JSON.
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { readFileSync } from "node:fs";
import { open } from "node:fs/promises";

const path = process.argv[2];
const file = await open(path, "r");
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, length) => {
    const bytes = new Uint8Array(Number(length));
    await file.read(bytes, 0, Number(length), Number(offset));
    return bytes;
  },
};
const indexed = {};
const reader = await McapIndexedReader.Initialize({ readable });
for await (const message of reader.readMessages()) {
  const topic = reader.channelsById.get(message.channelId).topic;
  indexed[topic] = (indexed[topic] ?? 0) + 1;
}
const stream = new McapStreamReader({ validateCrcs: true });
stream.append(readFileSync(path));
let streamed = 0;
for (let record; (record = stream.nextRecord()); ) {
  streamed += record.type === "Message" ? 1 : 0;
}
await file.close();
console.log(JSON.stringify({ indexed, streamed, done: stream.done() }));
