#include "messages.hpp"

#include "common.hpp"
#include "diagnostic_msgs.h"
#include "std_msgs.h"

namespace {

std::string text_json(const char* text) { return json_string(text == nullptr ? "" : text); }

std::string string_json(const void* sample) {
  const auto& message = *static_cast<const std_msgs_msg_dds__String_*>(sample);
  return "{\"data\":" + text_json(message.data) + "}";
}

std::string header_json(const std_msgs_msg_dds__Header_& header) {
  return "{\"stamp\":{\"sec\":" + std::to_string(header.stamp.sec) +
         ",\"nanosec\":" + std::to_string(header.stamp.nanosec) + "},\"frame_id\":" + text_json(header.frame_id) + "}";
}

// The items of a sequence.
template <typename Sequence, typename Json>
std::string list_json(const Sequence& sequence, Json json) {
  std::string list = "[";
  for (uint32_t at = 0; at < sequence._length; ++at) {
    if (at > 0) list += ",";
    list += json(sequence._buffer[at]);
  }
  return list + "]";
}

std::string key_value_json(const diagnostic_msgs_msg_dds__KeyValue_& pair) {
  return "{\"key\":" + text_json(pair.key) + ",\"value\":" + text_json(pair.value) + "}";
}

std::string status_json(const diagnostic_msgs_msg_dds__DiagnosticStatus_& status) {
  return "{\"level\":" + std::to_string(status.level) + ",\"name\":" + text_json(status.name) +
         ",\"message\":" + text_json(status.message) + ",\"hardware_id\":" + text_json(status.hardware_id) +
         ",\"values\":" + list_json(status.values, key_value_json) + "}";
}

std::string diagnostics_json(const void* sample) {
  const auto& message = *static_cast<const diagnostic_msgs_msg_dds__DiagnosticArray_*>(sample);
  return "{\"header\":" + header_json(message.header) + ",\"status\":" + list_json(message.status, status_json) + "}";
}

}  // namespace

const Message* message_named(const std::string& name) {
  static const Message string{&std_msgs_msg_dds__String__desc, string_json};
  static const Message diagnostics{&diagnostic_msgs_msg_dds__DiagnosticArray__desc, diagnostics_json};
  if (name == "string") return &string;
  if (name == "diagnostics") return &diagnostics;
  return nullptr;
}

dds_return_t write_string(dds_entity_t writer, const std::string& text) {
  const std_msgs_msg_dds__String_ message{const_cast<char*>(text.c_str())};
  return dds_write(writer, &message);
}
