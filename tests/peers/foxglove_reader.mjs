// Reads logs as Foxglove does, with its own packages: node foxglove_reader.mjs LOG...   One line of JSON for each.
// Every message is decoded by the schema inside of the file.
import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";
import protobufjs from "protobufjs";
import descriptor from "protobufjs/ext/descriptor/index.js";

function decoderOf(channel, schema) {
  if (channel.messageEncoding !== "protobuf" || schema.encoding !== "protobuf") {
    throw new Error(`expected protobuf, came ${channel.messageEncoding} and ${schema.encoding}`);
  }
  const root = protobufjs.Root.fromDescriptor(descriptor.FileDescriptorSet.decode(schema.data));
  root.resolveAll();
  const type = root.lookupType(schema.name);
  return (data) => type.toObject(type.decode(data), { defaults: true });
}

const decompressHandlers = await loadDecompressHandlers();
for (const path of process.argv.slice(2)) {
  const warnings = [];
  console.warn = console.error = (...words) => warnings.push(words.join(" "));
  const file = await open(path, "r");
  const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(file), decompressHandlers });
  const decoders = new Map();
  for (const channel of reader.channelsById.values()) {
    try {
      decoders.set(channel.id, decoderOf(channel, reader.schemasById.get(channel.schemaId)));
    } catch (error) {
      warnings.push(`${channel.topic}: ${error.message}`);
    }
  }
  const byTopic = {};
  let last = 0n;
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    const { topic } = reader.channelsById.get(message.channelId);
    decoders.get(message.channelId)?.(message.data);
    byTopic[topic] = (byTopic[topic] ?? 0) + 1;
    if (message.logTime < last) warnings.push(`${topic}: an instant before the last one`);
    last = message.logTime;
  }
  await file.close();
  const told = Number(reader.statistics?.messageCount);
  console.log(JSON.stringify({ warnings, told, byTopic, channels: reader.channelsById.size }));
}
