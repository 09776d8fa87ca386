// The ROS 2 messages that the peer on Cyclone DDS knows by their definitions (idl/), not as bytes.
#pragma once

#include <dds/dds.h>

#include <string>

struct Message {
  const dds_topic_descriptor_t* descriptor;
  // A decoded sample, with the names and the order of its definition.
  std::string (*json)(const void* sample);
};

// What --decode names; nullptr for a name that it does not have.
const Message* message_named(const std::string& name);

// Writes a std_msgs/msg/String.
dds_return_t write_string(dds_entity_t writer, const std::string& text);
