// What both peers share: the command line, payloads, statistics and JSON lines. README.md describes them.
#pragma once

#include <csignal>
#include <cstdint>
#include <cstdio>
#include <map>
#include <string>
#include <unordered_map>
#include <unordered_set>
#include <utility>
#include <vector>

// The command line, with its defaults.
struct Options {
  std::string role;
  uint32_t domain = 0;
  std::string topic = "rt/scan";
  std::string type = "sensor_msgs::msg::dds_::LaserScan_";
  bool reliable = true;
  bool transient_local = false;
  int32_t history_depth = 10;  // 0 is KEEP_ALL
  int32_t max_samples = 0;     // 0 is the library's default
  double max_blocking_s = 0.1;
  uint32_t keys = 0;           // 0 is a type without keys; else the key of sample `seq` is seq % keys
  std::string interface_ip;    // empty is every interface
  bool shared_memory = false;

  double rate_hz = 100;        // 0 is as fast as write() returns
  uint64_t count = 0;          // 0 is no limit
  double duration_s = 0;       // 0 is no limit
  uint64_t first_seq = 0;
  std::vector<uint32_t> sizes; // sample `seq` has sizes[seq % n] bytes; empty on a subscriber is "not checked"
  uint64_t seed = 1;
  bool plain = false;          // only the sequence at both ends of a payload is written and checked
  std::vector<uint8_t> encapsulation{0x00, 0x01, 0x00, 0x00};
  std::string payload_file;
  double source_age_s = 0;     // the source timestamp is so much older than the sample
  int32_t wait_match = 0;
  bool hold = false;           // a publisher begins at SIGUSR1
  uint64_t burst = 0;          // a publisher waits for SIGUSR1 after each so many samples; 0 is never
  bool prime = false;
  double heartbeat_s = 0;      // 0 is the library's default
  double linger_s = 0;
  bool say = false;            // a publisher sends the lines of stdin as std_msgs/msg/String

  std::string decode;          // a subscriber decodes this message by its definition
  bool opaque = false;         // the payload is not a peer's: no sequence, no check
  bool summary = false;        // no line per sample
  std::string record_file;     // each sample as a row of CSV
  double stall_every_s = 0;
  double stall_for_s = 0;
  uint32_t gid_bytes = 24;
};

// Parses the command line; prints what is wrong with it and exits with code 2.
Options parse_options(int argc, char** argv);

// Set by SIGINT and SIGTERM.
extern volatile std::sig_atomic_t stop_requested;
// Set by SIGUSR1.
extern volatile std::sig_atomic_t go_requested;
void handle_signals();

int64_t monotonic_ns();
int64_t realtime_ns();
// Sleeps until that monotonic time, or until a signal asks to stop.
void sleep_until(int64_t at_ns);

// One line of JSON to stdout, at once.
void emit(const std::string& json);
void emit_error(const std::string& message);
// The endpoints exist; `library` is the name of the DDS library with its version.
void emit_ready(const std::string& library);
// Text in UTF-8 as a JSON string; bytes that are none become U+FFFD.
std::string json_string(const std::string& text);
std::string hex(const uint8_t* bytes, size_t count);
// The bytes of text in hexadecimal; prints what is wrong with it and exits with code 2.
std::vector<uint8_t> hex_bytes(const std::string& text);

// The sequence number of a sample that only opens the way for others.
constexpr uint64_t priming_seq = UINT64_MAX;

// A file of rows, each written at once, so that it is whole when the program is killed; without a name there is none.
class Record {
 public:
  Record(const std::string& file, const char* header);
  ~Record();
  Record(const Record&) = delete;
  Record& operator=(const Record&) = delete;
  void row(uint64_t seq, int64_t time_ns, int64_t duration_ns);
  void row(uint64_t seq, int64_t time_ns, int64_t duration_ns, bool ok);

 private:
  std::FILE* file_ = nullptr;
};

// A serialized sample: its encapsulation header and what follows. In memory both are one block, as on the wire.
using Bytes = std::vector<uint8_t>;

// What the publishers send. The bytes after the header, little endian: 0..8 sequence, 8..16 send time
// (CLOCK_MONOTONIC, ns), 16..24 source timestamp (CLOCK_REALTIME, ns), then xorshift of seed and sequence; cut off
// at the sample's size. With --plain zeros instead, and the sequence again in the last 8.
class Publisher {
 public:
  explicit Publisher(const Options& options);

  // To be called before `run`: waits for the signal of --hold; with --prime sends a sample that does not count and
  // waits until `acknowledged(timeout_ns)`. A VOLATILE reader of Cyclone DDS takes all up to the last sample of
  // the first heartbeat that it sees for history, and drops what of it is still on its way.
  template <typename Write, typename Acknowledged>
  void begin(Write write, Acknowledged acknowledged) {
    while (options_.hold && !go_requested && !stop_requested) sleep_until(monotonic_ns() + 10'000'000);
    if (!options_.prime) return;
    make_priming_sample();
    write(bytes_, source_ns_);
    while (!stop_requested && !acknowledged(int64_t{100'000'000})) {
    }
  }

  // Hands out the samples at the rate of the options; `write(bytes, source_ns)` returns whether it succeeded.
  // Returns when all are sent or a signal came.
  template <typename Write>
  void run(Write write) {
    while (next()) {
      const int64_t before_ns = monotonic_ns();
      const bool ok = write(bytes_, source_ns_);
      record(ok, monotonic_ns() - before_ns);
    }
    finish_sending();
  }

  // Waits until all samples are acknowledged, 10 s at most, also after SIGTERM: a publisher that ends at once takes
  // the last samples with it, of which a reader may still miss fragments. Then lingers.
  template <typename Acknowledged>
  void linger(Acknowledged acknowledged) {
    const int64_t deadline_ns = monotonic_ns() + 10'000'000'000;
    while (!acknowledged_ && monotonic_ns() < deadline_ns) {
      acknowledged_ = acknowledged(int64_t{100'000'000});
    }
    emit(std::string("{\"event\":\"sent\",\"acknowledged\":") + (acknowledged_ ? "true}" : "false}"));
    sleep_until(monotonic_ns() + static_cast<int64_t>(options_.linger_s * 1e9));
  }

  void print_summary();

 private:
  bool next();
  void pause();
  void make_priming_sample();
  void record(bool ok, int64_t call_ns);
  void finish_sending();

  const Options& options_;
  Record record_;
  Bytes file_;
  Bytes bytes_;
  uint64_t seq_ = 0;
  int64_t sent_ns_ = 0;
  int64_t source_ns_ = 0;
  int64_t begin_ns_ = 0;
  int64_t end_ns_ = 0;
  int64_t due_ns_ = 0;
  int64_t progress_ns_ = 0;
  uint64_t attempted_ = 0;
  uint64_t ok_ = 0;
  uint64_t failed_ = 0;
  uint64_t skipped_ticks_ = 0;
  uint64_t hash_ = 0;
  std::vector<int64_t> calls_ns_;
  bool acknowledged_ = false;
};

// The key of a sample, header included, by its sequence number; 0 if it has none.
uint32_t key_of(const Bytes& bytes, uint32_t keys);
// A sample of the last sequence with that key, of which a library reads nothing but the key.
Bytes key_sample(uint32_t key);
// A key by its hash: of a key of at most 16 bytes, its big-endian CDR.
uint32_t key_of_hash(const uint8_t* hash);
void hash_of_key(uint32_t key, uint8_t* hash);

// What a subscriber has seen.
class Subscriber {
 public:
  explicit Subscriber(const Options& options);

  // One received sample, header included.
  void take(const uint8_t* bytes, size_t count, int64_t source_ns);
  // The state of that key as the library shows it with a sample: alive, disposed or no_writers.
  void state(uint32_t key, const std::string& state);
  // To be called about every 100 ms and after each batch: progress lines, and the sleep of --stall-every.
  void housekeeping();
  // Whether enough was received, the time is up, or a signal came.
  bool done() const;
  void print_summary();

 private:
  bool check(const uint8_t* payload, size_t count, uint64_t seq);

  const Options& options_;
  Record record_;
  int64_t begin_ns_ = 0;
  int64_t stalled_ns_ = 0;
  int64_t progress_ns_ = 0;
  uint64_t progress_received_ = 0;

  uint64_t received_ = 0;  // without duplicates
  uint64_t unnumbered_ = 0;
  uint64_t duplicates_ = 0;
  uint64_t out_of_order_ = 0;
  uint64_t bad_ = 0;
  uint64_t padded_ = 0;
  uint64_t source_kept_ = 0;
  uint64_t source_changed_ = 0;
  uint64_t payload_bytes_ = 0;
  uint64_t hash_ = 0;
  size_t size_min_ = SIZE_MAX;
  size_t size_max_ = 0;
  uint64_t last_ = 0;
  bool any_numbered_ = false;
  std::unordered_set<uint64_t> seen_;
  std::vector<int64_t> latencies_ns_;
  std::unordered_map<std::string, uint64_t> headers_;
  std::map<uint32_t, std::string> states_;
  int64_t last_arrival_ns_ = 0;
  int64_t max_gap_ns_ = 0;
};
