"use strict";
// A viewer with Foxglove's own client: subscribes to all channels, sets K, and ends when the alarm of that comes.
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const WebSocket = require("ws");

const client = new FoxgloveClient({ ws: new WebSocket(process.argv[2], [FoxgloveClient.SUPPORTED_SUBPROTOCOL]) });
const topics = new Map();
const seen = { parameters: {}, schemas: 0 };

client.on("error", (error) => {
  throw error;
});
client.on("status", ({ message }) => {
  throw new Error(message);
});
client.on("advertise", (channels) => {
  for (const channel of channels) {
    topics.set(client.subscribe(channel.id), channel.topic);
    seen.schemas += JSON.parse(channel.schema).type === "object";
  }
  client.getParameters([], "all");
});
client.on("parameterValues", ({ parameters }) => {
  for (const { name, value } of parameters) seen.parameters[name] = value;
});
client.on("message", ({ subscriptionId, data }) => {
  const topic = topics.get(subscriptionId);
  const message = JSON.parse(new TextDecoder().decode(data));
  seen[topic] = (seen[topic] ?? 0) + 1;
  if (topic === "/signals" && seen[topic] === 1000) client.setParameters([{ name: "K", value: 15000, type: "float64" }], "set");
  if (topic === "/alarms" && message.what === "K") {
    console.log(JSON.stringify({ ...seen, latency_n: message.latency_n }));
    process.exit(0);
  }
});
