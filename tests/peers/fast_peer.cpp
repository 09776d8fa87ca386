// A DDS peer on Fast DDS 2: publishes and subscribes serialized samples of any type.
#include <fastdds/dds/core/LoanableSequence.hpp>
#include <fastdds/dds/core/policy/QosPolicies.hpp>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/DataWriterListener.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/config.h>

#include <algorithm>
#include <atomic>
#include <cstring>
#include <fstream>
#include <memory>

#include "common.hpp"

namespace fast = eprosima::fastdds::dds;
namespace rtps = eprosima::fastrtps::rtps;
using eprosima::fastrtps::Duration_t;
using eprosima::fastrtps::types::ReturnCode_t;

namespace {

// The wanted socket buffer; the kernel gives at most net.core.[rw]mem_max, and Fast DDS takes less for an error.
uint32_t socket_buffer(const char* limit_file) {
  uint32_t limit = 4 << 20;
  std::ifstream file(limit_file);  // not there in every network namespace
  uint32_t allowed = 0;
  if (file >> allowed) limit = std::min(limit, allowed);
  return limit;
}

// Samples are `Bytes`, in memory and on the wire, encapsulation header included.
class RawType : public fast::TopicDataType {
 public:
  RawType(const std::string& name, uint32_t max_size, uint32_t keys) : keys_(keys) {
    setName(name.c_str());
    m_typeSize = max_size;
    m_isGetKeyDefined = keys > 0;
    auto_fill_type_object(false);
    auto_fill_type_information(false);
  }

  bool serialize(void* data, rtps::SerializedPayload_t* payload) override {
    const auto& bytes = *static_cast<const Bytes*>(data);
    if (bytes.size() > payload->max_size) return false;
    if (!bytes.empty()) std::memcpy(payload->data, bytes.data(), bytes.size());
    payload->length = static_cast<uint32_t>(bytes.size());
    payload->encapsulation = bytes.size() > 1 && bytes[1] % 2 == 0 ? CDR_BE : CDR_LE;
    return true;
  }

  bool deserialize(rtps::SerializedPayload_t* payload, void* data) override {
    static_cast<Bytes*>(data)->assign(payload->data, payload->data + payload->length);
    return true;
  }

  std::function<uint32_t()> getSerializedSizeProvider(void* data) override {
    return [data] { return static_cast<uint32_t>(static_cast<const Bytes*>(data)->size()); };
  }

  void* createData() override { return new Bytes(); }
  void deleteData(void* data) override { delete static_cast<Bytes*>(data); }
  bool getKey(void* data, rtps::InstanceHandle_t* handle, bool) override {
    if (keys_ == 0) return false;
    uint8_t hash[16];
    hash_of_key(key_of(*static_cast<const Bytes*>(data), keys_), hash);
    for (size_t at = 0; at < sizeof hash; ++at) handle->value[at] = hash[at];
    return true;
  }

 private:
  uint32_t keys_;
};

class Events : public fast::DataWriterListener, public fast::DataReaderListener {
 public:
  std::atomic<int32_t> matched{0};

  void on_publication_matched(fast::DataWriter*, const fast::PublicationMatchedStatus& status) override {
    emit_match(status.current_count, status.current_count_change);
  }
  void on_subscription_matched(fast::DataReader*, const fast::SubscriptionMatchedStatus& status) override {
    emit_match(status.current_count, status.current_count_change);
  }
  void on_offered_incompatible_qos(fast::DataWriter*, const fast::OfferedIncompatibleQosStatus& status) override {
    emit_incompatible(status.last_policy_id);
  }
  void on_requested_incompatible_qos(fast::DataReader*, const fast::RequestedIncompatibleQosStatus& status) override {
    emit_incompatible(status.last_policy_id);
  }

 private:
  void emit_match(int32_t current, int32_t change) {
    matched = current;
    emit("{\"event\":\"matched\",\"current\":" + std::to_string(current) + ",\"change\":" + std::to_string(change) +
         "}");
  }
  static void emit_incompatible(fast::QosPolicyId_t policy_id) {
    emit("{\"event\":\"incompatible_qos\",\"policy_id\":" + std::to_string(policy_id) + "}");
  }
};

template <typename Qos>
void set_qos(Qos& qos, const Options& options) {
  qos.reliability().kind = options.reliable ? fast::RELIABLE_RELIABILITY_QOS : fast::BEST_EFFORT_RELIABILITY_QOS;
  qos.reliability().max_blocking_time =
      Duration_t(static_cast<long double>(options.max_blocking_s));
  qos.durability().kind = options.transient_local ? fast::TRANSIENT_LOCAL_DURABILITY_QOS : fast::VOLATILE_DURABILITY_QOS;
  if (options.history_depth == 0) {
    qos.history().kind = fast::KEEP_ALL_HISTORY_QOS;
  } else {
    qos.history().kind = fast::KEEP_LAST_HISTORY_QOS;
    qos.history().depth = options.history_depth;
  }
  auto& limits = qos.resource_limits();
  if (options.max_samples > 0) limits.max_samples = options.max_samples;
  limits.max_samples = std::max(limits.max_samples, options.history_depth);
  limits.max_samples_per_instance = limits.max_samples;
  if (options.keys > 0) limits.max_samples *= std::max(1, limits.max_instances);
  limits.allocated_samples = std::min(limits.allocated_samples, limits.max_samples);
  // Sizes vary from a few bytes to megabytes: take the memory that each sample needs.
  // Fast DDS 2.9 has no room there for a sample without payload, as a disposed key is one.
  qos.endpoint().history_memory_policy =
      options.keys > 0 ? rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE : rtps::DYNAMIC_REUSABLE_MEMORY_MODE;
  if (!options.shared_memory) qos.data_sharing().off();
}

int publish(const Options& options, fast::DomainParticipant* participant, fast::Topic* topic, Events& events) {
  fast::DataWriterQos qos = fast::DATAWRITER_QOS_DEFAULT;
  set_qos(qos, options);
  if (options.heartbeat_s > 0) {
    qos.reliable_writer_qos().times.heartbeatPeriod = Duration_t(static_cast<long double>(options.heartbeat_s));
  }
  // Unregistered is not disposed.
  qos.writer_data_lifecycle().autodispose_unregistered_instances = false;
  fast::Publisher* parent = participant->create_publisher(fast::PUBLISHER_QOS_DEFAULT);
  fast::DataWriter* writer = parent == nullptr ? nullptr : parent->create_datawriter(topic, qos, &events);
  if (writer == nullptr) {
    emit_error("the writer could not be created");
    return 1;
  }
  emit_ready("Fast DDS " FASTRTPS_VERSION_STR);
  while (!stop_requested && events.matched < options.wait_match) sleep_until(monotonic_ns() + 10'000'000);
  Publisher publisher(options);
  const auto write = [&](const Bytes& bytes, int64_t source_ns) {
    rtps::WriteParams params;
    rtps::Time_t source_time;
    source_time.from_ns(source_ns);
    params.source_timestamp(source_time);
    return writer->write(const_cast<Bytes*>(&bytes), params);
  };
  const auto acknowledged = [&](int64_t timeout_ns) {
    const Duration_t timeout(static_cast<int32_t>(timeout_ns / 1'000'000'000),
                                  static_cast<uint32_t>(timeout_ns % 1'000'000'000));
    return writer->wait_for_acknowledgments(timeout) == ReturnCode_t::RETCODE_OK;
  };
  publisher.begin(write, acknowledged);
  publisher.run(write);
  if (options.keys > 2) {
    Bytes disposed = key_sample(1);
    Bytes unregistered = key_sample(2);
    if (writer->dispose(&disposed, writer->lookup_instance(&disposed)) != ReturnCode_t::RETCODE_OK ||
        writer->unregister_instance(&unregistered, writer->lookup_instance(&unregistered)) !=
            ReturnCode_t::RETCODE_OK) {
      emit_error("a key could not be disposed or unregistered");
    }
  }
  publisher.linger(acknowledged);
  publisher.print_summary();
  return 0;
}

// take_next_sample leaves out keys that are not alive.
void take_with_keys(fast::DataReader* reader, Subscriber& subscriber) {
  fast::LoanableSequence<Bytes> samples;
  fast::SampleInfoSeq infos;
  if (reader->take(samples, infos, 64) != ReturnCode_t::RETCODE_OK) return;
  for (fast::LoanableCollection::size_type at = 0; at < infos.length(); ++at) {
    const fast::SampleInfo& info = infos[at];
    if (info.valid_data) subscriber.take(samples[at].data(), samples[at].size(), info.source_timestamp.to_ns());
    uint8_t hash[16];
    for (size_t byte = 0; byte < sizeof hash; ++byte) hash[byte] = info.instance_handle.value[byte];
    subscriber.state(key_of_hash(hash), info.instance_state == fast::ALIVE_INSTANCE_STATE ? "alive"
                                        : info.instance_state == fast::NOT_ALIVE_DISPOSED_INSTANCE_STATE
                                            ? "disposed"
                                            : "no_writers");
  }
  reader->return_loan(samples, infos);
}

int subscribe(const Options& options, fast::DomainParticipant* participant, fast::Topic* topic, Events& events) {
  fast::DataReaderQos qos = fast::DATAREADER_QOS_DEFAULT;
  set_qos(qos, options);
  fast::Subscriber* parent = participant->create_subscriber(fast::SUBSCRIBER_QOS_DEFAULT);
  fast::DataReader* reader = parent == nullptr ? nullptr : parent->create_datareader(topic, qos, &events);
  if (reader == nullptr) {
    emit_error("the reader could not be created");
    return 1;
  }
  emit_ready("Fast DDS " FASTRTPS_VERSION_STR);
  Subscriber subscriber(options);
  Bytes bytes;
  fast::SampleInfo info;
  while (!subscriber.done()) {
    const bool is_unread = reader->wait_for_unread_message(Duration_t(0, 100'000'000));
    if (options.keys > 0) {
      take_with_keys(reader, subscriber);
    } else if (is_unread) {
      // At most so many in a row, so that housekeeping and signals get their turn in a flood.
      for (int taken = 0; taken < 64 && reader->take_next_sample(&bytes, &info) == ReturnCode_t::RETCODE_OK; ++taken) {
        if (info.valid_data) subscriber.take(bytes.data(), bytes.size(), info.source_timestamp.to_ns());
      }
    }
    subscriber.housekeeping();
  }
  subscriber.print_summary();
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  const Options options = parse_options(argc, argv);
  handle_signals();
  if (options.role == "graph" || options.role == "client" || options.say || !options.decode.empty()) {
    emit_error("fast_peer has no role graph or client, --say and --decode; cyclone_peer has");
    return 2;
  }

  fast::DomainParticipantQos qos = fast::PARTICIPANT_QOS_DEFAULT;
  qos.name("fast_peer");
  if (!options.shared_memory) {
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->sendBufferSize = socket_buffer("/proc/sys/net/core/wmem_max");
    udp->receiveBufferSize = socket_buffer("/proc/sys/net/core/rmem_max");
    if (!options.interface_ip.empty()) udp->interfaceWhiteList.push_back(options.interface_ip);
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(udp);
  }
  Events events;
  auto* factory = fast::DomainParticipantFactory::get_instance();
  fast::DomainParticipant* participant = factory->create_participant(options.domain, qos);
  if (participant == nullptr) {
    emit_error("the participant could not be created");
    return 1;
  }
  const uint32_t largest = options.sizes.empty() ? 0 : *std::max_element(options.sizes.begin(), options.sizes.end());
  const fast::TypeSupport type(new RawType(options.type, largest + 64, options.keys));
  type.register_type(participant);
  fast::Topic* topic = participant->create_topic(options.topic, options.type, fast::TOPIC_QOS_DEFAULT);
  if (topic == nullptr) {
    emit_error("the topic could not be created");
    return 1;
  }
  const int code = options.role == "pub" ? publish(options, participant, topic, events)
                                         : subscribe(options, participant, topic, events);
  participant->delete_contained_entities();
  factory->delete_participant(participant);
  return code;
}
