// use mio::Token;
use std::{
  collections::{BTreeSet, HashMap},
  io,
  io::ErrorKind,
  net::{IpAddr, Ipv4Addr},
  pin::Pin,
  sync::{atomic, Arc, Mutex, RwLock, Weak},
  task::{Context, Poll},
  thread,
  thread::JoinHandle,
  time::{Duration, Instant},
};

#[cfg(feature = "mio_06")]
use mio_06::{self, Evented};
#[cfg(feature = "mio_08")]
use mio_08::{Interest, Registry};
use futures::stream::{FusedStream, Stream};
#[allow(unused_imports)]
use log::{debug, error, info, trace, warn};

use crate::{
  create_error_bad_parameter, create_error_out_of_resources, create_error_poisoned,
  dds::{
    pubsub::*,
    qos::{policy::UserData, *},
    result::*,
    statusevents::{
      sync_status_channel, DomainParticipantStatusEvent, StatusChannelReceiver, StatusChannelSender,
    },
    topic::*,
    typedesc::TypeDesc,
  },
  discovery::{
    discovery::{Discovery, DiscoveryCommand},
    discovery_db::{discovery_db_read, DiscoveryDB},
    journal,
    sedp_messages::{DiscoveredReaderData, DiscoveredTopicData, DiscoveredWriterData},
    MAX_PARTICIPANT_USER_DATA,
  },
  network::{
    constant::*,
    udp_listener::UDPListener,
    util::{listener_locators, local_interface_table, IfAddr, NetworkSelector},
  },
  polling::{
    ready_channel, wake_channel, wake_channel_unbounded, Hooks, LoopWaker, ReadySender, ThreadTurns,
    WakeReceiver, WakeSender, WakeUnboundedSender,
  },
  rtps::{
    constant::*,
    dp_event_loop::{DPEventLoop, DomainInfo, EventLoopCommand},
    identity::{ParticipantIdentity, UsedNumbers},
    reader::*,
    writer::WriterIngredients,
  },
  structure::{dds_cache::DDSCache, entity::RTPSEntity, guid::*, locator::Locator},
  StatusEvented,
};
#[cfg(feature = "security")]
use crate::{
  create_error_internal, create_error_not_allowed_by_security,
  security::{
    self,
    config::DomainParticipantSecurityConfigFiles,
    security_plugins::{SecurityPlugins, SecurityPluginsHandle},
    AccessControl, Authentication, Cryptographic,
  },
};
#[cfg(not(feature = "security"))]
use crate::no_security::SecurityPluginsHandle;

/// Builder object to create a [`DomainParticipant`] with non-default
/// configuration.
///
/// Currently, the builder is mostly for configuring security, so the
/// functionality is very limited unless you are building RustDDS with
/// `security` feature enabled.
pub struct DomainParticipantBuilder {
  domain_id: u16,

  // Interfaces that are announced and used for multicast; `None` is all.
  only_networks: Option<Vec<NetworkSelector>>,

  same_host_loopback: bool, // prefer loopback for same-host peers + localhost SPDP discovery peers

  socket_receive_buffer_size: usize,
  socket_send_buffer_size: usize,

  hooks: Hooks,

  #[cfg(feature = "security")]
  security_plugins: Option<SecurityPlugins>,
  #[cfg(feature = "security")]
  sec_properties: Option<policy::Property>, // Properties for configuring security plugins
}

impl DomainParticipantBuilder {
  pub fn new(domain_id: u16) -> DomainParticipantBuilder {
    DomainParticipantBuilder {
      domain_id,
      only_networks: None,
      same_host_loopback: true,
      socket_receive_buffer_size: Self::DEFAULT_SOCKET_RECEIVE_BUFFER_SIZE,
      socket_send_buffer_size: Self::DEFAULT_SOCKET_SEND_BUFFER_SIZE,
      hooks: Hooks::default(),
      #[cfg(feature = "security")]
      security_plugins: None,
      #[cfg(feature = "security")]
      sec_properties: None,
    }
  }

  /// Filter which local network interfaces are used for multicast and
  /// advertised in discovery.
  ///
  /// When set, only interfaces whose IP address appears in `addrs` are used for
  /// multicast joins, multicast sends, and unicast locator advertisement.
  ///
  /// This is not a hard transport-level ACL: unicast sockets still bind to
  /// wildcard addresses for the selected ports.
  pub fn with_only_networks(mut self, addrs: impl IntoIterator<Item = impl Into<IpAddr>>) -> Self {
    self.only_networks = Some(
      addrs
        .into_iter()
        .map(|addr| NetworkSelector::Address(addr.into()))
        .collect(),
    );
    self
  }

  /// As [`with_only_networks`](Self::with_only_networks), with interfaces by name,
  /// too. They need not exist, or have an address, yet: interfaces that come later
  /// are used from then on.
  pub fn with_only_interfaces(
    mut self,
    selectors: impl IntoIterator<Item = NetworkSelector>,
  ) -> Self {
    self.only_networks = Some(selectors.into_iter().collect());
    self
  }

  /// Announces the participant also to these hosts by unicast, for networks without
  /// multicast: to the ports of their first [`SPDP_PEER_COUNT`] participants.
  ///
  /// [`SPDP_PEER_COUNT`]: crate::network::constant::SPDP_PEER_COUNT
  pub fn with_discovery_peers(mut self, addresses: impl IntoIterator<Item = Ipv4Addr>) -> Self {
    self.hooks.discovery_peers = addresses.into_iter().collect();
    self
  }

  /// Sets the Differentiated Services Code Point (RFC 2474), 0 to 63, of all datagrams
  /// that the participant sends by unicast.
  pub fn with_dscp(mut self, dscp: u8) -> Self {
    self.hooks.dscp = dscp;
    self
  }

  /// Gives the readers of these topics a UDP port of their own, which they announce
  /// without a multicast address. A datagram that arrives there is handled before those
  /// that wait in other sockets, so a small sample does not wait for the fragments of
  /// large ones that arrived before it.
  pub fn with_urgent_topics(mut self, names: impl IntoIterator<Item = String>) -> Self {
    self.hooks.urgent_topics = names.into_iter().collect();
    self
  }

  /// Limits the library's memory for samples of which fragments are missing, at all
  /// Readers of the participant together. When they need more, one sample is discarded of
  /// the Writer with the most of it at the Reader with the most of it, and counted in
  /// [`NetworkCounts::unfinished_discarded`](crate::NetworkCounts::unfinished_discarded).
  /// Without it, each Reader has its own
  /// [`max_total_bytes`](crate::AssemblyLimits::max_total_bytes).
  pub fn with_max_unfinished_bytes(mut self, bytes: usize) -> Self {
    self.hooks.max_unfinished_bytes = Some(bytes);
    self
  }

  /// Sets the USER_DATA (DDS v1.4 Section 2.2.3.1) that discovery announces with the
  /// participant: [`MAX_PARTICIPANT_USER_DATA`] bytes at most.
  ///
  /// [`MAX_PARTICIPANT_USER_DATA`]: crate::discovery::MAX_PARTICIPANT_USER_DATA
  pub fn with_user_data(mut self, user_data: UserData) -> Self {
    self.hooks.user_data = user_data.value;
    self
  }

  /// Takes over the identity of a participant whose process is gone: its GUID prefix, its
  /// ports, and numbers after those that it used. The participant can't be built if a port is
  /// taken. To others it is the same participant if its writers are the same, too; see
  /// [`Publisher::create_datawriter_raw_continuing`].
  pub fn continuing(mut self, identity: ParticipantIdentity) -> Self {
    self.hooks.numbers = Arc::new(UsedNumbers::after(&identity));
    self.hooks.identity = Some(identity);
    self
  }

  /// Takes over the sockets of a participant whose process is gone, with what has arrived in
  /// them since: those that its [`DomainParticipant::sockets`] returned, in any order. Those
  /// of ports that this one does not have are closed. The participant has
  /// [`DomainParticipant::sockets`] for a later one.
  #[cfg(unix)]
  pub fn with_sockets(mut self, sockets: Vec<std::net::UdpSocket>) -> Self {
    self.hooks.sockets = Some(sockets);
    self
  }

  /// Leaves what arrives for readers of the application in the sockets, until
  /// [`DomainParticipant::receive_user_traffic`]: what arrives before there is a reader that is
  /// matched with its writer is discarded.
  pub fn holding_user_traffic(mut self) -> Self {
    self.hooks.holds_user_traffic = true;
    self
  }

  /// Knows from the start what a former participant of the same identity knew of others: its
  /// [`DomainParticipant::discovery_journal`]. It is read as what comes from the network, and
  /// the participant can't be built if any of it is not sound. Readers that do not announce
  /// themselves within 10 s are forgotten.
  pub fn with_discovery_journal(mut self, journal: Vec<u8>) -> Self {
    self.hooks.journal = journal;
    self
  }

  /// Enable/disable same-host communication over loopback (default: enabled).
  ///
  /// When enabled, the participant (a) additionally announces SPDP to the
  /// "localhost peers" (`127.0.0.1:<well-known SPDP ports>`), letting two
  /// participants on the same host discover each other even with no external
  /// network or loopback multicast, and (b) prefers a peer's advertised
  /// loopback locator once that peer is positively confirmed to be on the same
  /// host. Disable to force all traffic onto regular (LAN) interfaces. See
  /// `src/rtps/loopback_same_host_design.md`.
  pub fn same_host_loopback(mut self, enabled: bool) -> Self {
    self.same_host_loopback = enabled;
    self
  }

  pub const DEFAULT_SOCKET_RECEIVE_BUFFER_SIZE: usize = 8 * 1024 * 1024;
  pub const DEFAULT_SOCKET_SEND_BUFFER_SIZE: usize = 8 * 1024 * 1024;

  /// Requested `SO_RCVBUF` (kernel receive buffer) for every UDP listener
  /// socket, in bytes. A large receive buffer absorbs traffic bursts before the
  /// single-threaded event loop can drain them, reducing packet loss under
  /// load. The default is 8 MiB.
  ///
  /// The kernel silently clamps the request to a per-socket ceiling; if the
  /// effective value ends up materially below what was requested, a warning is
  /// logged. To go above the ceiling, raise the OS limit first:
  /// - macOS: `sudo sysctl -w kern.ipc.maxsockbuf=<bytes>` (default is 8 MiB,
  ///   so the 8 MiB default here is already at the cap unless you raise it).
  /// - Linux: `sudo sysctl -w net.core.rmem_max=<bytes>` (note Linux reports
  ///   back roughly twice the requested size due to internal bookkeeping).
  pub fn socket_receive_buffer_size(mut self, size: usize) -> Self {
    self.socket_receive_buffer_size = size;
    self
  }

  /// Requested `SO_SNDBUF` (kernel send buffer) for every UDP sender socket, in
  /// bytes. A large send buffer smooths bursty output so the writer hits
  /// `WouldBlock` (and grows the control queue) less often. The default is
  /// 8 MiB.
  ///
  /// The kernel silently clamps the request to a per-socket ceiling; if the
  /// effective value ends up materially below what was requested, a warning is
  /// logged. To go above the ceiling, raise the OS limit first:
  /// - macOS: `sudo sysctl -w kern.ipc.maxsockbuf=<bytes>` (default is 8 MiB).
  /// - Linux: `sudo sysctl -w net.core.wmem_max=<bytes>`.
  pub fn socket_send_buffer_size(mut self, size: usize) -> Self {
    self.socket_send_buffer_size = size;
    self
  }

  /// Lets the participant's event loop call `hook`: after each datagram that it
  /// has handled, before it sends acknowledgements for it, and once in each of
  /// its turns; see [`DomainParticipant::wake_event_loop`]. With a waker on a
  /// DataReader that only notes that there is something, the application can
  /// take samples here, and saves the hand-over to a thread of its own.
  ///
  /// While it runs nothing is received, acknowledged or sent: it must return
  /// soon, wait for nothing, and not panic. If it has more to do than it does
  /// at once it returns true, and is called again in the next turn, which then
  /// follows without sleep. No lock is held. DataReaders may be read; a method
  /// of the participant, of topics, publishers or subscribers may wait for the
  /// event loop, for ever.
  pub fn on_received(mut self, hook: impl FnMut() -> bool + Send + 'static) -> Self {
    self.hooks.on_received = Some(Box::new(hook));
    self
  }

  /// Lets the participant's event loop call `hook` when it has a datagram that
  /// holds a sample of a user's writer or a part of one, before it looks who wants
  /// it: some microseconds before that of [`Self::on_received`]. The writer's GUID, its
  /// sequence number, and how many bytes of the sample come after this datagram,
  /// are what the datagram claims; nothing was checked. The rules for that hook
  /// hold.
  pub fn on_sample_arriving(
    mut self,
    hook: impl FnMut([u8; 16], i64, usize) + Send + 'static,
  ) -> Self {
    self.hooks.on_sample_arriving = Some(Box::new(hook));
    self
  }

  #[cfg(feature = "security")]
  /// Low-level security configuration, which allows supplying custom plugins.
  pub fn security(
    &mut self,
    auth: Box<impl Authentication + 'static>,
    access: Box<impl AccessControl + 'static>,
    crypto: Box<impl Cryptographic + 'static>,
    sec_properties: policy::Property,
  ) -> &mut DomainParticipantBuilder {
    self.security_plugins = Some(SecurityPlugins::new(auth, access, crypto));
    self.sec_properties = Some(sec_properties);
    self
  }

  #[cfg(feature = "security")]
  /// Easier way to configure security.
  pub fn builtin_security(mut self, configs: DomainParticipantSecurityConfigFiles) -> Self {
    let auth = Box::new(security::AuthenticationBuiltin::new());
    let access = Box::new(security::AccessControlBuiltin::new());
    let crypto = Box::new(security::CryptographicBuiltin::new());
    self.security(auth, access, crypto, configs.into_property_policy());
    self
  }

  pub fn build(#[allow(unused_mut)] mut self) -> CreateResult<DomainParticipant> {
    let user_data_bytes = self.hooks.user_data.len();
    if user_data_bytes > MAX_PARTICIPANT_USER_DATA {
      return create_error_bad_parameter!(
        "USER_DATA of {user_data_bytes} bytes; a participant announces at most {MAX_PARTICIPANT_USER_DATA}"
      );
    }

    if let Some(identity) = self.hooks.identity.filter(|identity| !identity.is_valid()) {
      return create_error_bad_parameter!("{identity:?} cannot be continued");
    }

    // QosPolicies with possible security properties, otherwise default
    let participant_qos = QosPolicies {
      #[cfg(feature = "security")]
      property: self.sec_properties,
      ..Default::default()
    };

    let candidate_participant_guid = match &self.hooks.identity {
      Some(identity) => GUID::new(GuidPrefix::new(&identity.prefix), EntityId::PARTICIPANT),
      None => GUID::new_participant_guid(),
    };
    #[cfg(not(feature = "security"))]
    let participant_guid = candidate_participant_guid;
    // If security plugins are present, security is enabled
    #[cfg(feature = "security")]
    let participant_guid = if let Some(ref mut security_plugins) = self.security_plugins.as_mut() {
      trace!("DomainParticipant security construction start");
      // Do the security checks according to DDS Security spec v1.1
      // Section "8.8.1 Authentication and AccessControl behavior with local
      // DomainParticipant". The other steps related to Discovery
      // (generating tokens etc.) are done when initializing Discovery.

      let sec_guid = match security_plugins.validate_local_identity(
        self.domain_id,
        &participant_qos,
        candidate_participant_guid,
      ) {
        Ok(guid) => guid,
        Err(e) => {
          return create_error_not_allowed_by_security!(
            "Validating local identity failed: {}",
            e.msg
          );
        }
      };

      if let Err(e) = security_plugins.validate_local_permissions(
        self.domain_id,
        sec_guid.prefix,
        &participant_qos,
      ) {
        return create_error_not_allowed_by_security!(
          "Validating local permissions failed: {}",
          e.msg
        );
      }

      match security_plugins.check_create_participant(
        self.domain_id,
        sec_guid.prefix,
        &participant_qos,
      ) {
        Ok(check_passed) => {
          if !check_passed {
            return create_error_not_allowed_by_security!(
              "Access control does not allow to create the local participant",
            );
          }
        }
        Err(e) => {
          return create_error_internal!(
            "Something went wrong in checking local participant permissions: {}",
            e
          );
        }
      }

      // Register participant with the crypto plugin
      if let Err(e) = security_plugins
        .get_participant_sec_attributes(sec_guid.prefix)
        .and_then(|sec_attr| {
          security_plugins.register_local_participant(
            sec_guid.prefix,
            participant_qos.property.clone(),
            sec_attr,
          )
        })
      {
        return create_error_internal!(
          "Could not register participant with crypto plugin {}",
          e.msg
        );
      };
      sec_guid
    } else {
      candidate_participant_guid
    };

    let journal = std::mem::take(&mut self.hooks.journal);
    let Some(known) = journal::read(&journal, participant_guid.prefix) else {
      return create_error_bad_parameter!("a journal of {} bytes is not sound", journal.len());
    };

    trace!("DomainParticipant construct start");

    // Discovery join channel is used to just send a join handle into the inner
    // participant, so its .drop() can wait until discovery has had a chance to
    // stop.
    let (djh_sender, djh_receiver) = std::sync::mpsc::channel();

    // One waker per reactor. Queues created now can enqueue before the loop
    // installs the waker; the loop drains once after install.
    let dp_waker = LoopWaker::new();
    let discovery_waker = LoopWaker::new();

    // Channel is used to notify Discovery of (duplicate) SPDP messages from the
    // wire.
    let (spdp_liveness_sender, spdp_liveness_receiver) = wake_channel(8, &discovery_waker);

    // Discovery thread receives and decodes updates from the wire.
    // It updates data to DiscoveryDB, and sends notifications to dp_event_loop,
    // which owns the Readers and Writers and notifies them also.
    let (discovery_updated_sender, discovery_update_notification_receiver) =
      wake_channel::<DiscoveryNotificationType>(32, &dp_waker);

    // This channel is used to:
    // * local DataReader and DataWriter notify Discovery on drop() so that
    // Discovery knows we no longer have them.
    // * Participant commands Discovery to assert liveness, i.e. send liveness
    // message to remote participants.
    // * Discovery commands Discovery (thread) to terminate on exit.
    // Capacity 1024 absorbs a few hundred endpoints created while Discovery is
    // busy, including while it blocks on the 32-slot notification channel back
    // to the event loop. Each create_datareader / create_datawriter enqueues
    // AddTopic plus AddLocalReader or AddLocalWriter, and try_send drops a
    // command that does not fit, so Discovery never announces that endpoint.
    // A still larger burst is dropped.
    let (discovery_command_sender, discovery_command_receiver) =
      wake_channel::<DiscoveryCommand>(1024, &discovery_waker);

    // Built-in discovery readers report new samples here. The token says which
    // reader. User readers do not use this queue.
    let (discovery_sample_sender, discovery_sample_receiver) =
      ready_channel::<mio1::Token>(&discovery_waker);

    // Channel used to report noteworthy events to DomainParticipant.
    // Capacity must be large enough to absorb the SEDP burst when multiple
    // participants are discovered at once. A single participant can expose
    // many endpoints (e.g. ~16 in a typical ROS 2 node), so 2048 handles
    // large deployments without silent event loss.
    let (status_sender, status_receiver) = sync_status_channel(2048)?;

    #[cfg(not(feature = "security"))]
    let security_plugins_handle = None;
    #[cfg(feature = "security")]
    let security_plugins_handle = self.security_plugins.map(SecurityPluginsHandle::new);

    // intermediate DP wrapper
    let dp = DomainParticipantDisc::new(
      self.domain_id,
      participant_guid,
      participant_qos,
      djh_receiver,
      discovery_update_notification_receiver,
      discovery_command_sender,
      spdp_liveness_sender,
      status_sender.clone(),
      status_receiver,
      security_plugins_handle.clone(),
      self.socket_receive_buffer_size,
      self.socket_send_buffer_size,
      self.only_networks,
      self.same_host_loopback,
      dp_waker,
      self.hooks,
      discovery_sample_sender,
    )?;

    // outer DP wrapper
    let dpi = Arc::new(Mutex::new(dp));
    let dp = DomainParticipant {
      discovery: Some(Arc::new(DiscoveryThread { dpi: dpi.clone() })),
      dpi,
    };

    let (discovery_started_sender, discovery_started_receiver) = std::sync::mpsc::channel();

    // Construct and start background thread
    let dp_clone = dp.weak_clone().of_discovery();
    let disc_db_clone = dp.discovery_db();
    let discovery_handle = thread::Builder::new()
      .name("RustDDS discovery thread".to_string())
      .spawn(move || {
        if let Ok(mut discovery) = Discovery::new(
          dp_clone,
          disc_db_clone,
          discovery_started_sender,
          discovery_updated_sender,
          discovery_command_receiver,
          spdp_liveness_receiver,
          status_sender,
          security_plugins_handle,
          discovery_waker,
          discovery_sample_receiver,
        ) {
          discovery.known = known;
          discovery.discovery_event_loop(); // run the event loop
        }
      })?;

    djh_sender.send(discovery_handle).unwrap_or(()); // send join handle to inner participant

    debug!("Waiting for discovery to start"); // blocking until discovery answers
    match discovery_started_receiver.recv_timeout(Duration::from_secs(10)) {
      Ok(Ok(())) => {
        // normal case
        info!("Discovery started. Participant constructed.");
        Ok(dp)
      }
      Ok(Err(e)) => {
        std::mem::drop(dp);
        create_error_poisoned!("Failed to start discovery thread: {e:?}")
      }
      Err(e) => create_error_poisoned!("Discovery thread channel error: {e:?}"),
    }
  }
}

/// DDS DomainParticipant
///
/// It is recommended that only one DomainParticipant per OS process is created,
/// as it allocates network sockets, creates background threads, and allocates
/// some memory for object caches.
///
/// If you need to communicate to many DDS domains,
/// then you must create a separate DomainParticipant for each of them.
/// See DDS Spec v1.4 Section "2.2.1.2.2 Overall Conceptual Model" and
/// "2.2.2.2.1 DomainParticipant Class" for a definition of a (DDS) domain.
/// Domains are identified by a domain identifier, which is, in Rust terms, a
/// `u16`. Domain identifier values are application-specific, but `0` is usually
/// the default.
///
/// # Panics
///
/// Most methods panic if an internal mutex or lock is poisoned (a prior panic
/// occurred in another thread while holding the lock). This indicates a RustDDS
/// internal defect, not user misuse.
#[derive(Clone)]
// This is a smart pointer for DomainParticipant for easier manipulation.
pub struct DomainParticipant {
  // Dropped before `dpi`: the thread that drops the last one ends discovery, then the event loop.
  // `None` in what the discovery thread has for a moment.
  discovery: Option<Arc<DiscoveryThread>>,
  dpi: Arc<Mutex<DomainParticipantDisc>>,
}

impl DomainParticipant {
  /// # Examples
  /// ```
  /// # use rustdds::DomainParticipant;
  ///
  /// let domain_participant = DomainParticipant::new(0).unwrap();
  /// ```
  pub fn new(domain_id: u16) -> CreateResult<Self> {
    let dp_builder = DomainParticipantBuilder::new(domain_id);
    dp_builder.build()
  }

  /// Creates DDS Publisher
  ///
  /// # Arguments
  ///
  /// * `qos` - Takes [qos policies](qos/struct.QosPolicies.html) for publisher
  ///   and given to DataWriter as default.
  ///
  /// # Examples
  ///
  /// ```
  /// # use rustdds::{DomainParticipant, QosPolicyBuilder};
  ///
  /// let domain_participant = DomainParticipant::new(0).unwrap();
  /// let qos = QosPolicyBuilder::new().build();
  /// let publisher = domain_participant.create_publisher(&qos);
  /// ```
  pub fn create_publisher(&self, qos: &QosPolicies) -> CreateResult<Publisher> {
    let w = self.weak_clone(); // this must be done first to avoid deadlock
    self.dpi.lock()?.create_publisher(&w, qos)
  }

  /// Creates DDS Subscriber
  ///
  /// # Arguments
  ///
  /// * `qos` - Takes [qos policies](qos/struct.QosPolicies.html) for subscriber
  ///   and given to DataReader as default.
  ///
  /// # Examples
  ///
  /// ```
  /// # use rustdds::{DomainParticipant, QosPolicyBuilder};
  ///
  /// let domain_participant = DomainParticipant::new(0).unwrap();
  /// let qos = QosPolicyBuilder::new().build();
  /// let subscriber = domain_participant.create_subscriber(&qos);
  /// ```
  pub fn create_subscriber(&self, qos: &QosPolicies) -> CreateResult<Subscriber> {
    // println!("DP(outer): create_subscriber");
    let w = self.weak_clone(); // do this first, avoid deadlock
    self.dpi.lock()?.create_subscriber(&w, qos)
  }

  /// Create DDS Topic
  ///
  /// # Arguments
  ///
  /// * `name` - Name of the topic.
  /// * `type_desc` - Name of the type this topic is supposed to deliver.
  /// * `qos` - Takes [qos policies](qos/struct.QosPolicies.html) that are
  ///   distributed to DataReaders and DataWriters.
  ///
  /// # Examples
  ///
  /// ```
  /// # use rustdds::{DomainParticipant, TopicKind, QosPolicyBuilder};
  ///
  /// let domain_participant = DomainParticipant::new(0).unwrap();
  /// let qos = QosPolicyBuilder::new().build();
  /// let topic = domain_participant.create_topic("some_topic".to_string(), "SomeType".to_string(), &qos, TopicKind::WithKey);
  /// ```
  pub fn create_topic(
    &self,
    name: String,
    type_desc: String,
    qos: &QosPolicies,
    topic_kind: TopicKind,
  ) -> CreateResult<Topic> {
    // println!("Create topic outer");
    let w = self.weak_clone();
    self
      .dpi
      .lock()?
      .create_topic(&w, name, type_desc, qos, topic_kind)
  }

  pub fn find_topic(&self, name: &str, timeout: Duration) -> CreateResult<Option<Topic>> {
    let w = self.weak_clone();
    self.dpi.lock()?.find_topic(&w, name, timeout)
  }

  /// # Examples
  ///
  /// ```
  /// # use rustdds::DomainParticipant;
  ///
  /// let domain_participant = DomainParticipant::new(0).unwrap();
  /// let domain_id = domain_participant.domain_id();
  /// ```
  pub fn domain_id(&self) -> u16 {
    self.dpi.lock().unwrap().domain_id()
  }

  /// # Examples
  ///
  /// ```
  /// # use rustdds::DomainParticipant;
  ///
  /// let domain_participant = DomainParticipant::new(0).unwrap();
  /// let participant_id = domain_participant.participant_id();
  /// ```
  pub fn participant_id(&self) -> u16 {
    self.dpi.lock().unwrap().participant_id()
  }

  /// What another participant needs to [continue](DomainParticipantBuilder::continuing) this
  /// one later, with the numbers used so far. `None` if that is not possible, because a socket
  /// has not the port that goes with the participant id.
  pub fn identity(&self) -> Option<ParticipantIdentity> {
    self.dpi.lock().ok()?.dpi.identity()
  }

  /// The participants that discovery knows, and their readers of topics that this one has, for
  /// [`DomainParticipantBuilder::with_discovery_journal`]. The same knowledge gives the same
  /// bytes.
  pub fn discovery_journal(&self) -> Vec<u8> {
    let own = self.guid().prefix;
    journal::write(&discovery_db_read(&self.discovery_db()), own)
  }

  /// Lets the event loop turn once, with a call of the hook that was given to
  /// [`DomainParticipantBuilder::on_received`].
  pub fn wake_event_loop(&self) {
    if let Ok(dpi) = self.dpi.lock() {
      dpi.dpi.event_loop_waker.wake();
    }
  }

  /// Lets the event loop and the discovery thread turn once, and returns how often each had begun a turn before.
  /// A count that does not grow from one call to the next, some time later, is that of a thread that hangs or
  /// has ended.
  pub fn wake_threads(&self) -> ThreadTurns {
    let Ok(dpi) = self.dpi.lock() else {
      return ThreadTurns::default();
    };
    let (event_loop, discovery) = (&dpi.dpi.event_loop_waker, dpi.discovery_command_sender.waker());
    let turns = ThreadTurns {
      event_loop: event_loop.turns(),
      discovery: discovery.turns(),
    };
    event_loop.wake();
    discovery.wake();
    turns
  }

  /// Counts what this participant refuses of the network.
  pub fn network_counters(&self) -> Arc<crate::NetworkCounters> {
    discovery_db_read(&self.discovery_db()).counters()
  }

  /// Ends [`DomainParticipantBuilder::holding_user_traffic`].
  pub fn receive_user_traffic(&self) {
    if let Ok(dpi) = self.dpi.lock() {
      let command = EventLoopCommand::ReceiveUserTraffic;
      if dpi.dpi.stop_poll_sender.send(command).is_err() {
        error!("dp_event_loop not responding to receive user traffic");
      }
    }
  }

  /// Duplicates of all sockets on which the participant receives, for one that continues it in
  /// another process. What arrives while this process is gone waits in them, as long as any
  /// process has them open. For a participant that was built with
  /// [`DomainParticipantBuilder::with_sockets`], once; an error otherwise, or if there were no
  /// descriptors.
  #[cfg(unix)]
  pub fn sockets(&self) -> io::Result<Vec<std::net::UdpSocket>> {
    let sockets = match self.dpi.lock() {
      Ok(mut dpi) => dpi.dpi.sockets.take(),
      Err(_) => None,
    };
    sockets.unwrap_or_else(|| Err(io::Error::other("no sockets to keep")))
  }

  /// The sockets that user traffic comes to, for a thread of the application that
  /// the kernel wakes together with the event loop. It may look at datagrams
  /// (`peek`, and [`sample_arriving`](crate::sample_arriving)) and must take none,
  /// nor change anything of the sockets, which do not block. For a participant with
  /// the hook [`DomainParticipantBuilder::on_sample_arriving`], once; an error
  /// otherwise, or if there were no descriptors. The ports stay bound as long as they
  /// are open.
  #[cfg(unix)]
  pub fn sockets_to_peek(&self) -> io::Result<Vec<std::net::UdpSocket>> {
    let sockets = match self.dpi.lock() {
      Ok(mut dpi) => dpi.dpi.sockets_to_peek.take(),
      Err(_) => None,
    };
    sockets.unwrap_or_else(|| Err(io::Error::other("no sockets to peek")))
  }


  /// Gets all DiscoveredTopics from DDS network
  ///
  /// # Examples
  ///
  /// ```
  /// # use rustdds::DomainParticipant;
  ///
  /// let domain_participant = DomainParticipant::new(0).unwrap();
  /// let discovered_topics = domain_participant.discovered_topics();
  /// for dtopic in discovered_topics.iter() {
  ///   // do something
  /// }
  /// ```
  pub fn discovered_topics(&self) -> Vec<DiscoveredTopicData> {
    self.dpi.lock().unwrap().discovered_topics()
  }

  /// Gets a snapshot of all Readers discovered over the DDS network.
  ///
  /// The `DomainParticipantStatusListener` reports Reader discovery as a live
  /// stream of events, so a listener that attaches late or drains slowly can
  /// miss some of them. This returns the full current set of discovered
  /// Readers from the internal discovery database instead.
  ///
  /// # Examples
  ///
  /// ```
  /// # use rustdds::DomainParticipant;
  ///
  /// let domain_participant = DomainParticipant::new(0).unwrap();
  /// let discovered_readers = domain_participant.discovered_readers();
  /// for dreader in discovered_readers.iter() {
  ///   // do something
  /// }
  /// ```
  pub fn discovered_readers(&self) -> Vec<DiscoveredReaderData> {
    self.dpi.lock().unwrap().discovered_readers()
  }

  /// Gets a snapshot of all Writers discovered over the DDS network.
  ///
  /// The `DomainParticipantStatusListener` reports Writer discovery as a live
  /// stream of events, so a listener that attaches late or drains slowly can
  /// miss some of them. This returns the full current set of discovered
  /// Writers from the internal discovery database instead.
  ///
  /// # Examples
  ///
  /// ```
  /// # use rustdds::DomainParticipant;
  ///
  /// let domain_participant = DomainParticipant::new(0).unwrap();
  /// let discovered_writers = domain_participant.discovered_writers();
  /// for dwriter in discovered_writers.iter() {
  ///   // do something
  /// }
  /// ```
  pub fn discovered_writers(&self) -> Vec<DiscoveredWriterData> {
    self.dpi.lock().unwrap().discovered_writers()
  }

  /// The events of all discovered Readers and Writers for which `is_known` returns false. It is called for each of
  /// them, while discovery waits. [`EndpointDescription::seen_from`](crate::EndpointDescription::seen_from) is not
  /// known.
  pub fn discovered_besides(
    &self,
    mut is_known: impl FnMut(GUID) -> bool,
  ) -> Vec<DomainParticipantStatusEvent> {
    let db = self.discovery_db();
    let db = db.read().unwrap_or_else(std::sync::PoisonError::into_inner);
    let mut events = Vec::new();
    for reader in db.get_all_external_topic_readers() {
      if !is_known(reader.reader_proxy.remote_reader_guid) {
        let reader = reader.describe(None);
        events.push(DomainParticipantStatusEvent::ReaderDetected { reader });
      }
    }
    for writer in db.get_all_external_topic_writers() {
      if !is_known(writer.writer_proxy.remote_writer_guid) {
        let writer = writer.describe(None);
        events.push(DomainParticipantStatusEvent::WriterDetected { writer });
      }
    }
    events
  }

  /// Manually asserts liveliness, affecting all writers with
  /// LIVELINESS QoS of MANUAL_BY_PARTICIPANT created by
  /// this particular participant.
  ///
  /// # Example
  ///
  /// ```
  /// # use rustdds::DomainParticipant;
  ///
  /// let domain_participant = DomainParticipant::new(0).expect("Failed to create participant");
  /// domain_participant.assert_liveliness();
  /// ```
  pub fn assert_liveliness(&self) -> WriteResult<(), ()> {
    self.dpi.lock()?.assert_liveliness()
  }

  /// Says goodbye on behalf of another participant, one that died and cannot:
  /// remote participants forget it and its endpoints at once, instead of when
  /// its lease ends.
  pub fn dispose_participant(&self, guid: GUID) -> WriteResult<(), ()> {
    self.dpi.lock()?.dispose_participant(guid)
  }

  /// Says goodbye on behalf of a writer of a former process, if this participant
  /// [continues](DomainParticipantBuilder::continuing) that one's and has no writer with
  /// that key. Whether its topic had keys may not be known any more.
  pub fn dispose_former_writer(&self, entity_key: [u8; 3]) -> WriteResult<(), ()> {
    let dpi = self.dpi.lock()?;
    // Others ignore the goodbye of a writer that they do not know.
    dpi.dispose_writer(EntityId::new(entity_key, EntityKind::WRITER_NO_KEY_USER_DEFINED))?;
    dpi.dispose_writer(EntityId::new(entity_key, EntityKind::WRITER_WITH_KEY_USER_DEFINED))
  }

  /// Readers of the topic that are made from now on begin after these samples of
  /// these writers: for an application that has taken them before, in this process
  /// or in an earlier one.
  pub fn begin_after(
    &self,
    topic: &Topic,
    taken: impl IntoIterator<Item = (GUID, crate::SequenceNumber)>,
  ) -> CreateResult<()> {
    let cache = self.dds_cache();
    let cache = cache
      .read()
      .map_err(|e| CreateError::Poisoned { reason: format!("DDSCache: {e}") })?;
    let topic_cache = cache.get_existing_topic_cache(&topic.name())?;
    let mut topic_cache = topic_cache
      .lock()
      .map_err(|e| CreateError::Poisoned { reason: format!("TopicCache: {e}") })?;
    topic_cache.taken = taken.into_iter().collect();
    Ok(())
  }

  /// Readers of the topic that are made from now on do not return samples that
  /// former Readers of the topic have received, which the participant keeps.
  pub fn begin_now(&self, topic: &Topic) -> CreateResult<()> {
    let cache = self.dds_cache();
    let cache = cache
      .read()
      .map_err(|e| CreateError::Poisoned { reason: format!("DDSCache: {e}") })?;
    let topic_cache = cache.get_existing_topic_cache(&topic.name())?;
    let mut topic_cache = topic_cache
      .lock()
      .map_err(|e| CreateError::Poisoned { reason: format!("TopicCache: {e}") })?;
    topic_cache.begin_now();
    Ok(())
  }

  /// Drops what the participant keeps of a topic for later Readers of it, once the
  /// application has dropped its Readers and Writers of the topic. Otherwise it is
  /// kept as long as the participant.
  pub fn forget_topic(&self, name: &str) {
    if let Ok(mut cache) = self.dds_cache().write() {
      cache.remove_topic(name);
    }
  }

  /// Get a `DomainDomainParticipantStatusListener` that can be used
  /// to get `DomainParticipantStatusEvent`s for this DomainParticipant.
  pub fn status_listener(&self) -> DomainParticipantStatusListener {
    DomainParticipantStatusListener {
      _discovery: self.discovery.clone(),
      dp_disc: Arc::clone(&self.dpi),
    }
  }

  pub(crate) fn weak_clone(&self) -> DomainParticipantWeak {
    DomainParticipantWeak::new(self)
  }

  pub(crate) fn dds_cache(&self) -> Arc<RwLock<DDSCache>> {
    self.dpi.lock().unwrap().dds_cache()
  }

  #[cfg(feature = "security")] // just to avoid warning
  pub(crate) fn qos(&self) -> QosPolicies {
    self.dpi.lock().unwrap().qos()
  }

  pub(crate) fn discovery_db(&self) -> Arc<RwLock<DiscoveryDB>> {
    self.dpi.lock().unwrap().dpi.discovery_db.clone()
  }

  pub(crate) fn new_entity_id(&self, entity_kind: EntityKind) -> EntityId {
    self.dpi.lock().unwrap().new_entity_id(entity_kind)
  }

  pub(crate) fn self_locators(&self) -> HashMap<mio1::Token, Vec<Locator>> {
    self.dpi.lock().unwrap().self_locators()
  }

  pub(crate) fn urgent_topics(&self) -> Arc<BTreeSet<String>> {
    Arc::clone(&self.dpi.lock().unwrap().dpi.urgent_topics)
  }

  pub(crate) fn numbers(&self) -> Arc<UsedNumbers> {
    Arc::clone(&self.dpi.lock().unwrap().dpi.numbers)
  }

  /// The USER_DATA that discovery announces.
  pub(crate) fn user_data(&self) -> Vec<u8> {
    self.dpi.lock().unwrap().dpi.user_data.clone()
  }

  /// Announces from now on the addresses that these interfaces have.
  pub(crate) fn follow_interfaces(&self, interfaces: &[IfAddr]) {
    self.dpi.lock().unwrap().dpi.follow_interfaces(interfaces);
  }
} // end impl DomainParticipant

// --------------------------------------------------------------------------
// --------------------------------------------------------------------------

/// Produces an async (or mio-pollable) stream of
/// [`DomainParticipantStatusEvent`]s
pub struct DomainParticipantStatusListener {
  // It is a handle of the user, too.
  _discovery: Option<Arc<DiscoveryThread>>,
  dp_disc: Arc<Mutex<DomainParticipantDisc>>,
}

impl DomainParticipantStatusListener {
  /// Whether an event was lost since the last call, because 2,048 others had not been taken.
  /// [`DomainParticipant::discovered_besides`] reads the Readers and Writers that there are.
  pub fn has_missed_events(&self) -> bool {
    match self.dp_disc.lock() {
      Ok(disc) => disc.status_channel_receiver().take_missed(),
      Err(_) => false,
    }
  }
}

impl<'a> StatusEvented<'a, DomainParticipantStatusEvent, DomainParticipantStatusStream<'a>>
  for DomainParticipantStatusListener
{
  #[cfg(feature = "mio_06")]
  fn as_status_evented(&mut self) -> &dyn Evented {
    self
  }

  #[cfg(feature = "mio_08")]
  fn as_status_source(&mut self) -> &mut dyn mio_08::event::Source {
    self
  }

  fn as_status_source_mio1(&mut self) -> &mut dyn mio1::event::Source {
    self
  }

  fn as_async_status_stream(&'a self) -> DomainParticipantStatusStream<'a> {
    DomainParticipantStatusStream {
      status_listener: self,
    }
  }

  fn try_recv_status(&self) -> Option<DomainParticipantStatusEvent> {
    self
      .dp_disc
      .lock()
      .unwrap()
      .status_channel_receiver()
      .try_recv_status()
  }
}

#[cfg(feature = "mio_08")]
impl mio_08::event::Source for DomainParticipantStatusListener {
  fn register(
    &mut self,
    registry: &Registry,
    token: mio_08::Token,
    interests: Interest,
  ) -> io::Result<()> {
    self
      .dp_disc
      .lock()
      .unwrap()
      .status_channel_receiver_mut()
      .register(registry, token, interests)
  }

  fn reregister(
    &mut self,
    registry: &Registry,
    token: mio_08::Token,
    interests: Interest,
  ) -> io::Result<()> {
    self
      .dp_disc
      .lock()
      .unwrap()
      .status_channel_receiver_mut()
      .reregister(registry, token, interests)
  }

  fn deregister(&mut self, registry: &Registry) -> io::Result<()> {
    self
      .dp_disc
      .lock()
      .unwrap()
      .status_channel_receiver_mut()
      .deregister(registry)
  }
}

impl mio1::event::Source for DomainParticipantStatusListener {
  fn register(
    &mut self,
    registry: &mio1::Registry,
    token: mio1::Token,
    interests: mio1::Interest,
  ) -> io::Result<()> {
    self
      .dp_disc
      .lock()
      .unwrap()
      .status_channel_receiver_mut()
      .register(registry, token, interests)
  }

  fn reregister(
    &mut self,
    registry: &mio1::Registry,
    token: mio1::Token,
    interests: mio1::Interest,
  ) -> io::Result<()> {
    self
      .dp_disc
      .lock()
      .unwrap()
      .status_channel_receiver_mut()
      .reregister(registry, token, interests)
  }

  fn deregister(&mut self, registry: &mio1::Registry) -> io::Result<()> {
    self
      .dp_disc
      .lock()
      .unwrap()
      .status_channel_receiver_mut()
      .deregister(registry)
  }
}

#[cfg(feature = "mio_06")]
impl mio_06::Evented for DomainParticipantStatusListener {
  // We just delegate all the operations to notification_receiver, since it
  // already implements Evented
  fn register(
    &self,
    poll: &mio_06::Poll,
    token: mio_06::Token,
    interest: mio_06::Ready,
    opts: mio_06::PollOpt,
  ) -> io::Result<()> {
    self
      .dp_disc
      .lock()
      .unwrap()
      .status_channel_receiver_mut()
      .as_status_evented()
      .register(poll, token, interest, opts)
  }

  fn reregister(
    &self,
    poll: &mio_06::Poll,
    token: mio_06::Token,
    interest: mio_06::Ready,
    opts: mio_06::PollOpt,
  ) -> io::Result<()> {
    self
      .dp_disc
      .lock()
      .unwrap()
      .status_channel_receiver_mut()
      .as_status_evented()
      .reregister(poll, token, interest, opts)
  }

  fn deregister(&self, poll: &mio_06::Poll) -> io::Result<()> {
    self
      .dp_disc
      .lock()
      .unwrap()
      .status_channel_receiver_mut()
      .as_status_evented()
      .deregister(poll)
  }
}

pub struct DomainParticipantStatusStream<'a> {
  status_listener: &'a DomainParticipantStatusListener,
}

impl Stream for DomainParticipantStatusStream<'_> {
  type Item = DomainParticipantStatusEvent;

  fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
    let dp_lock = self.status_listener.dp_disc.lock().unwrap();
    let mut w = dp_lock.status_channel_receiver().get_waker_update_lock();
    // lock already at the beginning, before try_recv
    match dp_lock.status_channel_receiver().try_recv() {
      Err(std::sync::mpsc::TryRecvError::Empty) => {
        // nothing available
        *w = Some(cx.waker().clone());
        Poll::Pending
      }
      Err(std::sync::mpsc::TryRecvError::Disconnected) => {
        error!("DomainParticipant status channel disconnected");
        Poll::Ready(None)
      }
      Ok(t) => Poll::Ready(Some(t)), // got data
    }
  } // fn
}

impl FusedStream for DomainParticipantStatusStream<'_> {
  fn is_terminated(&self) -> bool {
    false
  }
}

// --------------------------------------------------------------------------
// --------------------------------------------------------------------------

impl PartialEq for DomainParticipant {
  fn eq(&self, other: &Self) -> bool {
    self.guid() == other.guid()
      && self.domain_id() == other.domain_id()
      && self.participant_id() == other.participant_id()
  }
}

#[derive(Clone)]
pub struct DomainParticipantWeak {
  dpi: Weak<Mutex<DomainParticipantDisc>>,
  // `None` in that of the discovery thread.
  discovery: Option<Weak<DiscoveryThread>>,
  // This struct caches some items to avoid construction deadlocks
  #[cfg(feature = "security")] // just to avoid warning
  domain_id: u16,
  guid: GUID,
  #[cfg(feature = "security")] // just to avoid warning
  qos: QosPolicies,
}

impl DomainParticipantWeak {
  pub fn new(dp: &DomainParticipant) -> Self {
    Self {
      dpi: Arc::downgrade(&dp.dpi),
      discovery: dp.discovery.as_ref().map(Arc::downgrade),
      #[cfg(feature="security")] // just to avoid warning
      domain_id: dp.domain_id(),
      guid: dp.guid(),
      #[cfg(feature="security")] // just to avoid warning
      qos: dp.qos(),
    }
  }

  pub fn create_publisher(&self, qos: &QosPolicies) -> CreateResult<Publisher> {
    self
      .dpi
      .upgrade()
      .ok_or(CreateError::ResourceDropped {
        reason: "DomainParticipant".to_string(),
      })
      .and_then(|dpi| dpi.lock()?.create_publisher(self, qos))
  }

  pub fn create_subscriber(&self, qos: &QosPolicies) -> CreateResult<Subscriber> {
    self
      .dpi
      .upgrade()
      .ok_or(CreateError::ResourceDropped {
        reason: "DomainParticipant".to_string(),
      })
      .and_then(|dpi| dpi.lock()?.create_subscriber(self, qos))
  }

  #[cfg(feature = "security")] // just to avoid warning
  pub fn domain_id(&self) -> u16 {
    self.domain_id
  }

  #[cfg(feature = "security")] // just to avoid warning
  pub fn qos(&self) -> QosPolicies {
    self.qos.clone()
  }

  pub fn create_topic(
    &self,
    name: String,
    type_desc: String,
    qos: &QosPolicies,
    topic_kind: TopicKind,
  ) -> CreateResult<Topic> {
    self
      .dpi
      .upgrade()
      .ok_or(CreateError::ResourceDropped {
        reason: "DomainParticipant".to_string(),
      })
      .and_then(|dpi| {
        dpi
          .lock()?
          .create_topic(self, name, type_desc, qos, topic_kind)
      })
  }

  pub fn upgrade(self) -> Option<DomainParticipant> {
    let discovery = match &self.discovery {
      Some(discovery) => Some(discovery.upgrade()?),
      None => None,
    };
    let dpi = self.dpi.upgrade()?;
    Some(DomainParticipant { discovery, dpi })
  }

  // For the discovery thread, which must not wait for its own end.
  fn of_discovery(self) -> Self {
    Self {
      discovery: None,
      ..self
    }
  }
} // end impl

impl RTPSEntity for DomainParticipantWeak {
  fn guid(&self) -> GUID {
    self.guid
  }
}

// What the discovery thread shares with the handles of the user, which end it: see `DiscoveryThread`.
pub(crate) struct DomainParticipantDisc {
  dpi: DomainParticipantInner,
  // Discovery control
  discovery_command_sender: WakeSender<DiscoveryCommand>,
  discovery_join_handle: std::sync::mpsc::Receiver<JoinHandle<()>>,
  // This allows deterministic generation of EntityIds for DataReader, DataWriter, etc.
  entity_id_generator: atomic::AtomicU32,
}

impl DomainParticipantDisc {
  #[allow(clippy::too_many_arguments)]
  pub fn new(
    domain_id: u16,
    participant_guid: GUID,
    qos_policies: QosPolicies,
    discovery_join_handle: std::sync::mpsc::Receiver<JoinHandle<()>>,
    discovery_update_notification_receiver: WakeReceiver<DiscoveryNotificationType>,
    discovery_command_sender: WakeSender<DiscoveryCommand>,
    spdp_liveness_sender: WakeSender<GuidPrefix>,
    status_sender: StatusChannelSender<DomainParticipantStatusEvent>,
    status_receiver: StatusChannelReceiver<DomainParticipantStatusEvent>,
    security_plugins_handle: Option<SecurityPluginsHandle>,
    socket_receive_buffer_size: usize,
    socket_send_buffer_size: usize,
    only_networks: Option<Vec<NetworkSelector>>,
    same_host_loopback: bool,
    dp_waker: LoopWaker,
    hooks: Hooks,
    discovery_sample_sender: ReadySender<mio1::Token>,
  ) -> CreateResult<Self> {
    let dpi = DomainParticipantInner::new(
      domain_id,
      participant_guid,
      qos_policies,
      discovery_update_notification_receiver,
      discovery_command_sender.clone(),
      spdp_liveness_sender,
      status_sender,
      status_receiver,
      security_plugins_handle,
      socket_receive_buffer_size,
      socket_send_buffer_size,
      only_networks,
      same_host_loopback,
      dp_waker,
      hooks,
      discovery_sample_sender,
    )?;

    Ok(Self {
      dpi,
      discovery_command_sender,
      discovery_join_handle,
      entity_id_generator: atomic::AtomicU32::new(0),
    })
  }

  // This generates identifiers that consist of given EntityKind and arbitrary,
  // unique identifier.
  pub(crate) fn new_entity_id(&self, entity_kind: EntityKind) -> EntityId {
    let [_goldilocks, papa_byte, mama_byte, baby_byte] = self
      .entity_id_generator
      .fetch_add(1, atomic::Ordering::Relaxed)
      .to_be_bytes();
    EntityId::new([papa_byte, mama_byte, baby_byte], entity_kind)
  }

  pub fn create_publisher(
    &self,
    dp: &DomainParticipantWeak,
    qos: &QosPolicies,
  ) -> CreateResult<Publisher> {
    self
      .dpi
      .create_publisher(dp, qos, self.discovery_command_sender.clone())
  }

  pub fn create_subscriber(
    &self,
    dp: &DomainParticipantWeak,
    qos: &QosPolicies,
  ) -> CreateResult<Subscriber> {
    self
      .dpi
      .create_subscriber(dp, qos, self.discovery_command_sender.clone())
  }

  pub fn create_topic(
    &self,
    dp: &DomainParticipantWeak,
    name: String,
    type_desc: String,
    qos: &QosPolicies,
    topic_kind: TopicKind,
  ) -> CreateResult<Topic> {
    // println!("Create topic disc");
    self.dpi.create_topic(dp, name, type_desc, qos, topic_kind)
  }

  pub fn find_topic(
    &self,
    dp: &DomainParticipantWeak,
    name: &str,
    timeout: Duration,
  ) -> CreateResult<Option<Topic>> {
    self.dpi.find_topic(dp, name, timeout)
  }

  pub fn domain_id(&self) -> u16 {
    self.dpi.domain_id()
  }

  pub fn participant_id(&self) -> u16 {
    self.dpi.participant_id()
  }

  pub fn discovered_topics(&self) -> Vec<DiscoveredTopicData> {
    self.dpi.discovered_topics()
  }

  pub fn discovered_readers(&self) -> Vec<DiscoveredReaderData> {
    self.dpi.discovered_readers()
  }

  pub fn discovered_writers(&self) -> Vec<DiscoveredWriterData> {
    self.dpi.discovered_writers()
  }

  pub(crate) fn dds_cache(&self) -> Arc<RwLock<DDSCache>> {
    self.dpi.dds_cache()
  }


  #[cfg(feature = "security")] // just to avoid warning
  pub(crate) fn qos(&self) -> QosPolicies {
    self.dpi.qos()
  }

  // pub(crate) fn discovery_db(&self) -> Arc<RwLock<DiscoveryDB>> {
  //   self.dpi.lock().unwrap().discovery_db.clone()
  // }

  pub(crate) fn assert_liveliness(&self) -> WriteResult<(), ()> {
    // No point in checking for the LIVELINESS QoS of MANUAL_BY_PARTICIPANT,
    // the discovery command mutates a field which is only read
    // by writers with that particular QoS.
    self
      .discovery_command_sender
      .send(DiscoveryCommand::ManualAssertLiveliness)
      // TODO: Are there more severe reasons than channel full? Is WouldBlock correct?
      .map_err(|_e| WriteError::WouldBlock { data: () })
  }

  pub(crate) fn dispose_participant(&self, guid: GUID) -> WriteResult<(), ()> {
    self
      .discovery_command_sender
      .send(DiscoveryCommand::DisposeParticipant { guid })
      .map_err(|_e| WriteError::WouldBlock { data: () })
  }

  pub(crate) fn dispose_writer(&self, entity_id: EntityId) -> WriteResult<(), ()> {
    let guid = GUID::new(self.guid().prefix, entity_id);
    self
      .discovery_command_sender
      .send(DiscoveryCommand::RemoveLocalWriter { guid })
      .map_err(|_e| WriteError::WouldBlock { data: () })
  }

  pub(crate) fn self_locators(&self) -> HashMap<mio1::Token, Vec<Locator>> {
    self.dpi.self_locators.clone()
  }

  pub(crate) fn status_channel_receiver(
    &self,
  ) -> &StatusChannelReceiver<DomainParticipantStatusEvent> {
    self.dpi.status_channel_receiver()
  }
  pub(crate) fn status_channel_receiver_mut(
    &mut self,
  ) -> &mut StatusChannelReceiver<DomainParticipantStatusEvent> {
    self.dpi.status_channel_receiver_mut()
  }
}

// Ends the discovery thread when the last handle of the user is dropped.
struct DiscoveryThread {
  dpi: Arc<Mutex<DomainParticipantDisc>>,
}

impl Drop for DiscoveryThread {
  fn drop(&mut self) {
    info!("===== RustDDS shutting down ===== .drop() DiscoveryThread");

    // Unlocked before it waits: the thread may be about to lock it, and its queue may be full.
    let (commands, handle) = {
      let disc = self.dpi.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
      debug!("Wan dp_event_loop about stop.");
      if disc
        .dpi
        .stop_poll_sender
        .send(EventLoopCommand::PrepareStop)
        .is_err()
      {
        error!("dp_event_loop not responding to prepare stop discovery_command");
      }
      let handle = disc.discovery_join_handle.try_recv();
      (disc.discovery_command_sender.clone(), handle)
    };

    debug!("Sending Discovery Stop signal.");
    if commands.send(DiscoveryCommand::StopDiscovery).is_err() {
      warn!("Failed to send stop signal to Discovery");
      return;
    }

    debug!("Waiting for Discovery join.");
    if let Ok(handle) = handle {
      handle
        .join()
        .unwrap_or_else(|e| warn!("Failed to join discovery thread: {e:?}"));
      debug!("Joined Discovery.");
    }
  }
}

// This is the actual working DomainParticipant.
pub(crate) struct DomainParticipantInner {
  domain_info: DomainInfo,

  #[cfg(feature = "security")] // just to avoid warning
  my_qos_policies: QosPolicies,

  // Adding Readers
  sender_add_reader: WakeSender<ReaderIngredients>,
  sender_remove_reader: WakeSender<GUID>,
  /// Reader-command ready queue. A send records the reader entity id.
  reader_ready: ReadySender<EntityId>,
  /// Built-in discovery readers enqueue their poll token here.
  discovery_sample_sender: ReadySender<mio1::Token>,

  // dp_event_loop control
  stop_poll_sender: WakeUnboundedSender<EventLoopCommand>,
  ev_loop_handle: Option<JoinHandle<()>>, // this is Option, because it needs to be extracted
  // out of the struct (take) in order to .join() on the handle.

  // Writers
  add_writer_sender: WakeSender<WriterIngredients>,
  remove_writer_sender: WakeSender<GUID>,
  /// Writer doorbell ready queue. Ringing records the writer entity id.
  writer_ready: ReadySender<EntityId>,
  event_loop_waker: LoopWaker,

  dds_cache: Arc<RwLock<DDSCache>>,
  discovery_db: Arc<RwLock<DiscoveryDB>>,
  discovery_db_event_receiver: std::sync::mpsc::Receiver<()>,

  // status event receiver
  status_receiver: StatusChannelReceiver<DomainParticipantStatusEvent>,

  // RTPS locators describing how to reach this DP
  self_locators: HashMap<mio1::Token, Vec<Locator>>,
  // Topics whose readers announce the listener for urgent traffic.
  urgent_topics: Arc<BTreeSet<String>>,
  // Of the participant, for discovery.
  user_data: Vec<u8>,
  numbers: Arc<UsedNumbers>,
  // Port of each listener, and whether it is one to multicast.
  listener_kinds: HashMap<mio1::Token, (u16, bool)>,

  security_plugins_handle: Option<SecurityPluginsHandle>,

  only_networks: Option<Arc<[NetworkSelector]>>,

  /// See `DomainParticipant::sockets_to_peek`.
  #[cfg(unix)]
  sockets_to_peek: Option<io::Result<Vec<std::net::UdpSocket>>>,
  /// See `DomainParticipant::sockets`.
  #[cfg(unix)]
  sockets: Option<io::Result<Vec<std::net::UdpSocket>>>,
}

impl Drop for DomainParticipantInner {
  fn drop(&mut self) {
    // if send has an error simply leave as we have lost control of the
    // ev_loop_thread anyways
    if self.stop_poll_sender.send(EventLoopCommand::Stop).is_err() {
      error!("dp_event_loop not responding to stop discovery_command");
      return;
    }

    debug!("Waiting for dp_event_loop join");
    match self.ev_loop_handle.take() {
      Some(join_handle) => {
        join_handle
          .join()
          .unwrap_or_else(|e| warn!("Failed to join dp_event_loop: {e:?}"));
      }
      None => {
        error!("Someone managed to steal dp_event_loop join handle from DomainParticipantInner.");
      }
    }
    debug!("Joined dp_event_loop");
  }
}

impl DomainParticipantInner {
  #[allow(clippy::too_many_arguments)]
  fn new(
    domain_id: u16,
    participant_guid: GUID,
    _qos_policies: QosPolicies,
    discovery_update_notification_receiver: WakeReceiver<DiscoveryNotificationType>,
    discovery_command_sender: WakeSender<DiscoveryCommand>,
    spdp_liveness_sender: WakeSender<GuidPrefix>,
    status_sender: StatusChannelSender<DomainParticipantStatusEvent>,
    status_receiver: StatusChannelReceiver<DomainParticipantStatusEvent>,
    security_plugins_handle: Option<SecurityPluginsHandle>,
    socket_receive_buffer_size: usize,
    socket_send_buffer_size: usize,
    only_networks: Option<Vec<NetworkSelector>>,
    same_host_loopback: bool,
    dp_waker: LoopWaker,
    mut hooks: Hooks,
    discovery_sample_sender: ReadySender<mio1::Token>,
  ) -> CreateResult<Self> {
    #[cfg(not(feature = "security"))]
    let _dummy = _qos_policies; // to make clippy happy

    let only_networks: Option<Arc<[NetworkSelector]>> = only_networks.map(|v| v.into());
    let interfaces = local_interface_table();

    let mut listeners = HashMap::new();

    #[cfg(unix)]
    let keeps_sockets = hooks.sockets.is_some();
    let mut kept = hooks.sockets.take().unwrap_or_default();
    let mut kept_with_port = |port: u16| {
      let of_port = |socket: &std::net::UdpSocket| {
        let address = socket.local_addr().ok();
        address.is_some_and(|address| address.port() == port && address.ip().is_unspecified())
      };
      let place = kept.iter().position(of_port)?;
      Some(kept.swap_remove(place))
    };

    match UDPListener::new_multicast_with_buf_size(
      "0.0.0.0",
      spdp_well_known_multicast_port(domain_id),
      Ipv4Addr::new(239, 255, 0, 1),
      socket_receive_buffer_size,
      &interfaces,
      only_networks.as_deref(),
      kept_with_port(spdp_well_known_multicast_port(domain_id)),
    ) {
      Ok(l) => {
        listeners.insert(DISCOVERY_MUL_LISTENER_TOKEN, l);
      }
      Err(e) => warn!("Cannot get multicast discovery listener: {e:?}"),
    }

    let continued_id = hooks.identity.map(|identity| identity.participant_id);
    let mut participant_id = continued_id.unwrap_or(0);
    let last_participant_id = continued_id.unwrap_or(119);

    let mut discovery_listener = None;

    // The value 119 above is from RTPS spec 2.5 Section "9.6.2.3 Default Port
    // Numbers"
    while discovery_listener.is_none() && participant_id <= last_participant_id {
      discovery_listener = UDPListener::new_unicast_with_buf_size(
        "0.0.0.0",
        spdp_well_known_unicast_port(domain_id, participant_id),
        socket_receive_buffer_size,
        &interfaces,
        kept_with_port(spdp_well_known_unicast_port(domain_id, participant_id)),
      )
      .ok();
      if discovery_listener.is_none() {
        participant_id += 1;
      }
    }

    info!("ParticipantId {participant_id} selected.");

    // here discovery_listener is redefined (shadowed)
    let discovery_listener = match discovery_listener {
      Some(dl) => dl,
      None => return create_error_out_of_resources!("Could not find free ParticipantId"),
    };
    listeners.insert(DISCOVERY_LISTENER_TOKEN, discovery_listener);

    // Now the user traffic listeners

    match UDPListener::new_multicast_with_buf_size(
      "0.0.0.0",
      user_traffic_multicast_port(domain_id),
      Ipv4Addr::new(239, 255, 0, 1),
      socket_receive_buffer_size,
      &interfaces,
      only_networks.as_deref(),
      kept_with_port(user_traffic_multicast_port(domain_id)),
    ) {
      Ok(l) => {
        listeners.insert(USER_TRAFFIC_MUL_LISTENER_TOKEN, l);
      }
      Err(e) => warn!("Cannot get multicast user traffic listener: {e:?}"),
    }

    let user_traffic_listener = UDPListener::new_unicast_with_buf_size(
      "0.0.0.0",
      user_traffic_unicast_port(domain_id, participant_id),
      socket_receive_buffer_size,
      &interfaces,
      kept_with_port(user_traffic_unicast_port(domain_id, participant_id)),
    )
    .or_else(|e| {
      if matches!(e.kind(), ErrorKind::AddrInUse) && continued_id.is_none() {
        // If we do not get the preferred listening port,
        // try again, with "any" port number.
        UDPListener::new_unicast_with_buf_size(
          "0.0.0.0",
          0,
          socket_receive_buffer_size,
          &interfaces,
          None,
        )
        .or_else(|e| {
          create_error_out_of_resources!(
            "Could not open unicast user traffic listener, any port number: {:?}",
            e
          )
        })
      } else {
        create_error_out_of_resources!("Could not open unicast user traffic listener: {e:?}")
      }
    })?;

    listeners.insert(USER_TRAFFIC_LISTENER_TOKEN, user_traffic_listener);

    let user_data = std::mem::take(&mut hooks.user_data);
    let numbers = Arc::clone(&hooks.numbers);
    let mut urgent_topics = std::mem::take(&mut hooks.urgent_topics);
    let continued_port = hooks.identity.map_or(0, |identity| identity.urgent_port);
    if !urgent_topics.is_empty() {
      let size = socket_receive_buffer_size;
      let socket = kept_with_port(continued_port);
      match UDPListener::new_unicast_with_buf_size(
        "0.0.0.0",
        continued_port,
        size,
        &interfaces,
        socket,
      ) {
        Ok(listener) => {
          listeners.insert(URGENT_TRAFFIC_LISTENER_TOKEN, listener);
        }
        Err(e) if continued_port != 0 => {
          return create_error_out_of_resources!(
            "Could not open the port of urgent topics, {continued_port}: {e}"
          )
        }
        // They are received as all others are.
        Err(e) => {
          warn!("Cannot open a socket for urgent topics: {e}");
          urgent_topics.clear();
        }
      }
    }

    #[cfg(unix)]
    let sockets_to_peek = hooks.on_sample_arriving.is_some().then(|| {
      [
        USER_TRAFFIC_LISTENER_TOKEN,
        USER_TRAFFIC_MUL_LISTENER_TOKEN,
        URGENT_TRAFFIC_LISTENER_TOKEN,
      ]
      .iter()
      .filter_map(|token| listeners.get(token))
      .map(UDPListener::duplicate)
      .collect()
    });

    #[cfg(unix)]
    let sockets = keeps_sockets.then(|| listeners.values().map(UDPListener::duplicate).collect());

    // construct our own Locators
    let listener_kinds = listeners
      .iter()
      .filter_map(|(token, listener)| match listener.kind() {
        Ok(kind) => Some((*token, kind)),
        Err(e) => {
          error!("No local network address for token {token:?}: {e:?}");
          None
        }
      })
      .collect();
    let self_locators =
      Self::locators_of(&listener_kinds, &interfaces, only_networks.as_deref());

    // Adding readers. Capacities match the previous mio-extras channels.
    let (sender_add_reader, receiver_add_reader) =
      wake_channel::<ReaderIngredients>(100, &dp_waker);
    let (sender_remove_reader, receiver_remove_reader) = wake_channel::<GUID>(4, &dp_waker);

    // Writers
    let (add_writer_sender, add_writer_receiver) = wake_channel::<WriterIngredients>(10, &dp_waker);
    let (remove_writer_sender, remove_writer_receiver) = wake_channel::<GUID>(4, &dp_waker);
    let (reader_ready, reader_ready_rx) = ready_channel(&dp_waker);
    let (writer_ready, writer_ready_rx) = ready_channel(&dp_waker);

    let domain_info = DomainInfo {
      domain_participant_guid: participant_guid,
      domain_id,
      participant_id,
    };
    let domain_info_clone = domain_info.clone();

    let dds_cache = Arc::new(RwLock::new(DDSCache::new()));
    let dds_cache_clone = Arc::clone(&dds_cache);

    let (discovery_db_event_sender, discovery_db_event_receiver) =
      std::sync::mpsc::sync_channel::<()>(1);

    // Discovert DB creation
    let discovery_db = Arc::new(RwLock::new(DiscoveryDB::new(
      participant_guid,
      discovery_db_event_sender,
      status_sender.clone(),
    )));

    let (stop_poll_sender, stop_poll_receiver) = wake_channel_unbounded(&dp_waker);

    let (ev_ready_tx, ev_ready_rx) = std::sync::mpsc::sync_channel::<CreateResult<()>>(1);

    // Launch the background thread for DomainParticipant
    let disc_db_clone = discovery_db.clone();
    let security_plugins_clone = security_plugins_handle.clone();
    let only_networks_for_ev_loop = only_networks.clone();
    let event_loop_waker = dp_waker.clone();
    let ev_loop_handle = thread::Builder::new()
      .name(format!("RustDDS Participant {participant_id} event loop"))
      .spawn(move || {
        match DPEventLoop::new(
          domain_info_clone,
          dds_cache_clone,
          listeners,
          disc_db_clone,
          participant_guid.prefix,
          TokenReceiverPair {
            token: ADD_READER_TOKEN,
            receiver: receiver_add_reader,
          },
          TokenReceiverPair {
            token: REMOVE_READER_TOKEN,
            receiver: receiver_remove_reader,
          },
          TokenReceiverPair {
            token: ADD_WRITER_TOKEN,
            receiver: add_writer_receiver,
          },
          TokenReceiverPair {
            token: REMOVE_WRITER_TOKEN,
            receiver: remove_writer_receiver,
          },
          stop_poll_receiver,
          discovery_update_notification_receiver,
          discovery_command_sender,
          spdp_liveness_sender,
          status_sender,
          security_plugins_clone,
          only_networks_for_ev_loop,
          interfaces,
          socket_send_buffer_size,
          same_host_loopback,
          reader_ready_rx,
          writer_ready_rx,
          dp_waker,
          hooks,
        ) {
          Ok(dp_event_loop) => {
            let _ = ev_ready_tx.send(Ok(()));
            dp_event_loop.event_loop();
          }
          Err(e) => {
            let _ = ev_ready_tx.send(Err(e));
          }
        }
      })?;

    match ev_ready_rx.recv() {
      Ok(Ok(())) => {}
      Ok(Err(e)) => return Err(e),
      Err(e) => {
        return create_error_poisoned!("dp_event_loop ready handshake failed: {e:?}");
      }
    }

    #[cfg(feature = "security")]
    let have_security = true;
    #[cfg(not(feature = "security"))]
    let have_security = false;

    info!(
      "New DomainParticipantInner: domain_id={domain_id:?} participant_id={participant_id:?} \
       GUID={participant_guid:?} security_feature_enabled={have_security}",
    );

    Ok(Self {
      domain_info,
      #[cfg(feature = "security")]
      my_qos_policies: _qos_policies,
      sender_add_reader,
      sender_remove_reader,
      reader_ready,
      discovery_sample_sender,
      stop_poll_sender,
      ev_loop_handle: Some(ev_loop_handle),
      add_writer_sender,
      remove_writer_sender,
      writer_ready,
      event_loop_waker,
      dds_cache,
      discovery_db,
      discovery_db_event_receiver,
      status_receiver,
      self_locators,
      urgent_topics: Arc::new(urgent_topics),
      user_data,
      numbers,
      listener_kinds,
      security_plugins_handle,
      only_networks,
      #[cfg(unix)]
      sockets_to_peek,
      #[cfg(unix)]
      sockets,
    })
  }

  pub fn dds_cache(&self) -> Arc<RwLock<DDSCache>> {
    self.dds_cache.clone()
  }

  fn locators_of(
    listener_kinds: &HashMap<mio1::Token, (u16, bool)>,
    interfaces: &[IfAddr],
    only_networks: Option<&[NetworkSelector]>,
  ) -> HashMap<mio1::Token, Vec<Locator>> {
    listener_kinds
      .iter()
      .map(|(token, (port, is_multicast))| {
        let locators = listener_locators(interfaces, *port, *is_multicast, only_networks);
        (*token, locators)
      })
      .collect()
  }

  fn follow_interfaces(&mut self, interfaces: &[IfAddr]) {
    self.self_locators =
      Self::locators_of(&self.listener_kinds, interfaces, self.only_networks.as_deref());
  }

  #[cfg(feature = "security")] // just to avoid warning
  pub(crate) fn qos(&self) -> QosPolicies {
    self.my_qos_policies.clone()
  }

  // Publisher and subscriber creation
  //
  // There are no delete function for publisher or subscriber. Deletion is
  // performed by deleting the Publisher or Subscriber object, who upon deletion
  // will notify the DomainParticipant.
  pub fn create_publisher(
    &self,
    domain_participant: &DomainParticipantWeak,
    qos: &QosPolicies,
    discovery_command: WakeSender<DiscoveryCommand>,
  ) -> CreateResult<Publisher> {
    Ok(Publisher::new(
      domain_participant.clone(),
      self.discovery_db.clone(),
      qos.clone(),
      qos.clone(),
      self.add_writer_sender.clone(),
      self.remove_writer_sender.clone(),
      discovery_command,
      self.security_plugins_handle.clone(),
      self.writer_ready.clone(),
    ))
  }

  pub fn create_subscriber(
    &self,
    domain_participant: &DomainParticipantWeak,
    qos: &QosPolicies,
    discovery_command: WakeSender<DiscoveryCommand>,
  ) -> CreateResult<Subscriber> {
    Ok(Subscriber::new(
      domain_participant.clone(),
      self.discovery_db.clone(),
      qos.clone(),
      self.sender_add_reader.clone(),
      self.sender_remove_reader.clone(),
      discovery_command,
      self.security_plugins_handle.clone(),
      self.reader_ready.clone(),
      self.discovery_sample_sender.clone(),
    ))
  }

  // Topic creation. Data types should be handled as something (potentially) more
  // structured than a String. NOTE: Here we are using &str for topic name. &str
  // is Unicode string, whereas DDS specifies topic name to be a sequence of
  // octets, which would be &[u8] in Rust. This may cause problems if there are
  // topic names with non-ASCII characters. On the other hand, string handling
  // with &str is easier in Rust.
  pub fn create_topic(
    &self,
    domain_participant_weak: &DomainParticipantWeak,
    name: String,
    type_desc: String,
    qos: &QosPolicies,
    topic_kind: TopicKind,
  ) -> CreateResult<Topic> {
    #[cfg(feature = "security")]
    if let Some(sec_handle) = self.security_plugins_handle.as_ref() {
      // Security is enabled.
      // Check are we allowed to create the topic from Access control
      let check_res = sec_handle.get_plugins().check_create_topic(
        self.guid().prefix,
        self.domain_id(),
        name.clone(),
        qos,
      );
      match check_res {
        Ok(check_passed) => {
          if !check_passed {
            return create_error_not_allowed_by_security!(
              "Not allowed to create the topic {}",
              name
            );
          }
        }
        Err(e) => {
          // Something went wrong in the check
          return create_error_internal!(
            "Failed to check Topic rights from Access control: {}",
            e.msg
          );
        }
      };
    }

    let topic_type_desc = TypeDesc::new(type_desc);
    let topic = Topic::new(
      domain_participant_weak,
      name.clone(),
      topic_type_desc.clone(),
      qos,
      topic_kind,
    );

    // Create the topic cache entry
    let mut dds_cache_guard = self.dds_cache.write()?;
    dds_cache_guard.add_new_topic(name, topic_type_desc, qos);

    Ok(topic)
  }

  // Do not implement content filtered topics or multi-topics (yet)

  pub fn find_topic(
    &self,
    domain_participant_weak: &DomainParticipantWeak,
    name: &str,
    timeout: Duration,
  ) -> CreateResult<Option<Topic>> {
    let find_end = Instant::now() + timeout;
    loop {
      if let Some(topic) = self.find_topic_in_discovery_db(domain_participant_weak, name)? {
        return Ok(Some(topic));
      }

      let remaining = find_end.saturating_duration_since(Instant::now());
      if remaining.is_zero() {
        break;
      }

      match self.discovery_db_event_receiver.recv_timeout(remaining) {
        Ok(()) | Err(std::sync::mpsc::RecvTimeoutError::Timeout) => {}
        Err(std::sync::mpsc::RecvTimeoutError::Disconnected) => {
          return Err(CreateError::Internal {
            reason: "Discovery database notification channel disconnected.".to_string(),
          });
        }
      }
    }

    Ok(None)
  }

  fn find_topic_in_discovery_db(
    &self,
    domain_participant_weak: &DomainParticipantWeak,
    name: &str,
  ) -> CreateResult<Option<Topic>> {
    let db = self
      .discovery_db
      .read()
      .map_err(|_| CreateError::Poisoned {
        reason: "discovery db".to_string(),
      })?;

    let build_topic_fn = |d: &DiscoveredTopicData| {
      let qos = d.topic_data.qos();
      let topic_kind = match d.topic_data.key {
        Some(_) => TopicKind::WithKey,
        None => TopicKind::NoKey,
      };
      let name = d.topic_name().clone();
      let type_desc = d.topic_data.type_name.clone();
      self.create_topic(domain_participant_weak, name, type_desc, &qos, topic_kind)
    };

    if let Some(d) = db.get_topic(name) {
      // build a Topic from DiscoveredTopicData
      build_topic_fn(d).map(Some)
    } else {
      Ok(None)
    }
  }
  // get_builtin_subscriber (why would we need this?)

  // ignore_* operations. TODO: Do we need any of those?

  // delete_contained_entities is not needed. Data structures should be designed
  // so that lifetime of all created objects is within the lifetime of
  // DomainParticipant. Then such deletion is implicit.

  // The following methods are not for application use.

  // pub(crate) fn get_add_reader_sender(&self) ->
  // mio_channel::SyncSender<ReaderIngredients> {   self.sender_add_reader.
  // clone() }

  // pub(crate) fn get_remove_reader_sender(&self) ->
  // mio_channel::SyncSender<GUID> {   self.sender_remove_reader.clone()
  // }

  // pub(crate) fn get_add_writer_sender(&self) ->
  // mio_channel::SyncSender<WriterIngredients> {   self.add_writer_sender.
  // clone() }

  // pub(crate) fn get_remove_writer_sender(&self) ->
  // mio_channel::SyncSender<GUID> {   self.remove_writer_sender.clone()
  // }

  pub fn domain_id(&self) -> u16 {
    self.domain_info.domain_id
  }

  pub fn participant_id(&self) -> u16 {
    self.domain_info.participant_id
  }

  fn identity(&self) -> Option<ParticipantIdentity> {
    let DomainInfo {
      domain_participant_guid,
      domain_id,
      participant_id,
    } = self.domain_info;
    let port = user_traffic_unicast_port(domain_id, participant_id);
    let listeners = &self.listener_kinds;
    let has_port = listeners.get(&USER_TRAFFIC_LISTENER_TOKEN) == Some(&(port, false));
    let urgent_port = listeners.get(&URGENT_TRAFFIC_LISTENER_TOKEN).map_or(0, |(port, _)| *port);
    has_port.then(|| ParticipantIdentity {
      prefix: domain_participant_guid.prefix.bytes,
      participant_id,
      urgent_port,
      highest_count: self.numbers.highest_count(),
      highest_number: self.numbers.highest_number().into(),
    })
  }

  pub fn discovered_topics(&self) -> Vec<DiscoveredTopicData> {
    let db = self.discovery_db.read().unwrap_or_else(|e| {
      panic!("RustDDS internal bug: DiscoveryDB is poisoned after a prior panic: {e:?}")
    });

    db.all_user_topics().cloned().collect()
  }

  pub fn discovered_readers(&self) -> Vec<DiscoveredReaderData> {
    let db = self.discovery_db.read().unwrap_or_else(|e| {
      panic!("RustDDS internal bug: DiscoveryDB is poisoned after a prior panic: {e:?}")
    });

    db.get_all_external_topic_readers().cloned().collect()
  }

  pub fn discovered_writers(&self) -> Vec<DiscoveredWriterData> {
    let db = self.discovery_db.read().unwrap_or_else(|e| {
      panic!("RustDDS internal bug: DiscoveryDB is poisoned after a prior panic: {e:?}")
    });

    db.get_all_external_topic_writers().cloned().collect()
  }

  pub(crate) fn status_channel_receiver(
    &self,
  ) -> &StatusChannelReceiver<DomainParticipantStatusEvent> {
    &self.status_receiver
  }
  pub(crate) fn status_channel_receiver_mut(
    &mut self,
  ) -> &mut StatusChannelReceiver<DomainParticipantStatusEvent> {
    &mut self.status_receiver
  }
} // impl

impl RTPSEntity for DomainParticipant {
  fn guid(&self) -> GUID {
    self.dpi.lock().unwrap().guid()
  }
}

impl RTPSEntity for DomainParticipantDisc {
  fn guid(&self) -> GUID {
    self.dpi.guid()
  }
}

impl RTPSEntity for DomainParticipantInner {
  fn guid(&self) -> GUID {
    self.domain_info.domain_participant_guid
  }
}

impl std::fmt::Debug for DomainParticipant {
  fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
    f.debug_struct("DomainParticipant")
      .field("Guid", &self.guid())
      .finish()
  }
}

#[cfg(test)]
mod tests {
  use std::{
    collections::BTreeSet,
    net::{Ipv4Addr, SocketAddr, SocketAddrV4},
  };

  use enumflags2::BitFlags;
  use log::info;
  use speedy::{Endianness, Writable};
  use byteorder::LittleEndian;

  use crate::{
    dds::{qos::QosPolicies, topic::TopicKind},
    messages::{
      header::Header, protocol_id::ProtocolId, protocol_version::ProtocolVersion,
      submessages::submessages::*, vendor_id::VendorId,
    },
    network::{
      constant::{
        spdp_well_known_unicast_port, user_traffic_multicast_port, user_traffic_unicast_port,
      },
      udp_sender::UDPSender,
    },
    rtps::{submessage::*, Message},
    serialization::CDRSerializerAdapter,
    structure::{
      entity::RTPSEntity,
      guid::{EntityId, GUID},
      locator::Locator,
      sequence_number::{SequenceNumber, SequenceNumberSet},
    },
    test::{random_data::RandomData, test_domain::test_domain_id},
  };
  use super::{DomainParticipant, DomainParticipantBuilder, ParticipantIdentity};

  // The identity, once the participant has announced itself with a number above this one.
  fn announced(participant: &DomainParticipant, number: i64) -> ParticipantIdentity {
    loop {
      let identity = participant.identity().unwrap();
      if identity.highest_number > number {
        return identity;
      }
      std::thread::sleep(std::time::Duration::from_millis(1));
    }
  }

  // The event loop is in a hook of the application when discovery ends.
  #[test]
  fn the_goodbye_of_a_busy_participant_is_sent() {
    use crate::dds::statusevents::{DomainParticipantStatusEvent, LostReason, StatusEvented};

    let domain = test_domain_id(42);
    let other = DomainParticipant::new(domain).unwrap();
    let events = other.status_listener();
    let is_busy = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
    let busy = is_busy.clone();
    let participant = DomainParticipantBuilder::new(domain)
      .on_received(move || {
        if busy.load(std::sync::atomic::Ordering::Relaxed) {
          std::thread::sleep(std::time::Duration::from_millis(500));
        }
        false
      })
      .build()
      .unwrap();
    let prefix = participant.guid().prefix;
    let wait = |is_wanted: &dyn Fn(&DomainParticipantStatusEvent) -> bool| {
      for _ in 0..500 {
        while let Some(event) = events.try_recv_status() {
          if is_wanted(&event) {
            return true;
          }
        }
        std::thread::sleep(std::time::Duration::from_millis(10));
      }
      false
    };
    assert!(wait(&|event| matches!(event,
      DomainParticipantStatusEvent::ParticipantDiscovered { dpd } if dpd.guid.prefix == prefix)));
    is_busy.store(true, std::sync::atomic::Ordering::Relaxed);
    participant.wake_event_loop();
    std::thread::sleep(std::time::Duration::from_millis(50));
    drop(participant);
    // Without it the other one waits for the end of the lease.
    assert!(wait(&|event| matches!(event,
      DomainParticipantStatusEvent::ParticipantLost { id, reason: LostReason::Disposed } if *id == prefix)));
  }

  // When announcements of the participant arrive until then, and whether each is a goodbye.
  #[cfg(not(feature = "security"))]
  fn arrivals(
    socket: &std::net::UdpSocket,
    of: GUID,
    until: std::time::Instant,
  ) -> Vec<(std::time::Instant, bool)> {
    use std::time::Instant;

    use crate::{
      messages::submessages::submessage_flag::DATA_Flags,
      rtps::{submessage::SubmessageBody, Message},
    };

    let mut arrivals = Vec::new();
    let mut buffer = [0; 4096];
    loop {
      let left = until.saturating_duration_since(Instant::now());
      if left.is_zero() {
        return arrivals;
      }
      socket.set_read_timeout(Some(left)).unwrap();
      let Ok((length, _)) = socket.recv_from(&mut buffer) else {
        return arrivals;
      };
      let now = Instant::now();
      let message = Message::read_from_buffer(&bytes::Bytes::copy_from_slice(&buffer[..length])).unwrap();
      for submessage in &message.submessages {
        if let SubmessageBody::Writer(WriterSubmessage::Data(data, flags)) = &submessage.body {
          if message.header.guid_prefix == of.prefix
            && data.writer_id == EntityId::SPDP_BUILTIN_PARTICIPANT_WRITER
          {
            arrivals.push((now, !flags.contains(DATA_Flags::Data)));
          }
        }
      }
    }
  }

  // Fast DDS handles multicast and unicast in two threads. The goodbye is due when the next announcement to
  // all is.
  #[test]
  #[cfg(not(feature = "security"))]
  fn a_goodbye_is_apart_from_announcements() {
    use std::{
      net::UdpSocket,
      time::{Duration, Instant},
    };

    use crate::{
      discovery::discovery::DiscoveryCommand, test::test_data::spdp_participant_msg_mod,
    };

    const PERIOD: Duration = Duration::from_secs(2);
    const APART: Duration = Duration::from_millis(50);

    let domain = test_domain_id(40);
    let bind = |port| UdpSocket::bind(("127.0.0.1", port)).unwrap();
    let (newcomer, neighbour) = (bind(0), bind(spdp_well_known_unicast_port(domain, 5)));
    let participant = DomainParticipant::new(domain).unwrap();
    let own = participant.guid();
    // Its built-in readers are there once it announces itself.
    while arrivals(&neighbour, own, Instant::now() + Duration::from_millis(20)).is_empty() {}
    let announcement = spdp_participant_msg_mod(newcomer.local_addr().unwrap().port());
    let prefix = announcement.header.guid_prefix;
    let datagram = announcement.write_to_vec_with_ctx(Endianness::LittleEndian).unwrap();
    for participant_id in 0..5 {
      let port = spdp_well_known_unicast_port(domain, participant_id);
      newcomer.send_to(&datagram, ("127.0.0.1", port)).unwrap();
    }
    for _ in 0..5 {
      while arrivals(&neighbour, own, Instant::now() + Duration::from_millis(20)).is_empty() {}
      std::thread::sleep(PERIOD - Duration::from_millis(130));
      let command = DiscoveryCommand::ReintroduceTo { prefix };
      participant.dpi.lock().unwrap().discovery_command_sender.send(command).unwrap();
      let until = Instant::now() + Duration::from_secs(1);
      let (to_one, to_all) = std::thread::scope(|scope| {
        let to_all = scope.spawn(|| arrivals(&neighbour, own, until));
        (arrivals(&newcomer, own, until), to_all.join().unwrap())
      });
      let goodbye = to_one.iter().find(|(_, is_goodbye)| *is_goodbye);
      let (goodbye, _) = *goodbye.expect("no goodbye");
      let announced = to_one.iter().filter(|(_, is_goodbye)| !*is_goodbye);
      assert!(announced.clone().any(|(at, _)| *at > goodbye), "no announcement after the goodbye");
      let is_apart = |at: &Instant| at.max(&goodbye).duration_since(*at.min(&goodbye)) >= APART;
      // The test may have been held up.
      if !to_all.is_empty() && announced.chain(&to_all).all(|(at, _)| is_apart(at)) {
        return;
      }
    }
    panic!("an announcement comes with each goodbye");
  }

  // It has just matched the Writers of this one, and would match them again after a goodbye.
  #[test]
  #[cfg(not(feature = "security"))]
  fn a_participant_that_comes_back_by_itself_is_told_no_goodbye() {
    use std::{
      net::UdpSocket,
      time::{Duration, Instant},
    };

    use crate::{
      discovery::discovery::DiscoveryCommand, test::test_data::spdp_participant_msg_mod,
    };

    let domain = test_domain_id(17);
    let bind = |port| UdpSocket::bind(("127.0.0.1", port)).unwrap();
    let (returning, neighbour) = (bind(0), bind(spdp_well_known_unicast_port(domain, 5)));
    let participant = DomainParticipant::new(domain).unwrap();
    let own = participant.guid();
    while arrivals(&neighbour, own, Instant::now() + Duration::from_millis(20)).is_empty() {}
    let announcement = spdp_participant_msg_mod(returning.local_addr().unwrap().port());
    let prefix = announcement.header.guid_prefix;
    let datagram = announcement.write_to_vec_with_ctx(Endianness::LittleEndian).unwrap();
    let command = DiscoveryCommand::ReintroduceTo { prefix };
    participant.dpi.lock().unwrap().discovery_command_sender.send(command).unwrap();
    std::thread::sleep(Duration::from_millis(20));
    for participant_id in 0..5 {
      let port = spdp_well_known_unicast_port(domain, participant_id);
      returning.send_to(&datagram, ("127.0.0.1", port)).unwrap();
    }
    let arrived = arrivals(&returning, own, Instant::now() + Duration::from_millis(500));
    assert!(!arrived.is_empty(), "no announcement");
    assert!(!arrived.iter().any(|(_, is_goodbye)| *is_goodbye), "{arrived:?}");
  }

  // The event loop is slow: discovery has read both announcements before it handles the first.
  #[test]
  fn a_writer_is_discovered_before_it_is_lost() {
    use crate::dds::statusevents::{DomainParticipantStatusEvent, StatusEvented};

    let domain = test_domain_id(41);
    let is_slow = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
    let slow = is_slow.clone();
    let here = DomainParticipantBuilder::new(domain)
      .on_received(move || {
        if slow.load(std::sync::atomic::Ordering::Relaxed) {
          std::thread::sleep(std::time::Duration::from_millis(100));
        }
        false
      })
      .build()
      .unwrap();
    let events = here.status_listener();
    let there = DomainParticipant::new(domain).unwrap();
    let qos = QosPolicies::qos_none();
    let publisher = there.create_publisher(&qos).unwrap();
    let topic = there.create_topic("t".to_string(), "T".to_string(), &qos, TopicKind::NoKey).unwrap();
    let seen_of = |guid: GUID, last: &str| {
      let mut seen = Vec::new();
      let mut polls_left = 1_000;
      while polls_left > 0 {
        polls_left -= 1;
        while let Some(event) = events.try_recv_status() {
          match event {
            DomainParticipantStatusEvent::WriterDetected { writer } if writer.guid == guid => {
              seen.push("found");
            }
            DomainParticipantStatusEvent::WriterLost { guid: lost, .. } if lost == guid => {
              seen.push("lost");
            }
            _ => (),
          }
        }
        if seen.contains(&last) {
          // What comes after it comes soon.
          polls_left = polls_left.min(100);
        }
        std::thread::sleep(std::time::Duration::from_millis(10));
      }
      // An announcement may come twice.
      seen.dedup();
      seen
    };
    let first = publisher.create_datawriter_no_key_cdr::<u32>(&topic, None).unwrap();
    assert_eq!(seen_of(first.guid(), "found"), ["found"]);
    is_slow.store(true, std::sync::atomic::Ordering::Relaxed);
    let second = publisher.create_datawriter_no_key_cdr::<u32>(&topic, None).unwrap();
    let guid = second.guid();
    // Announced, and in the hook of the other participant.
    std::thread::sleep(std::time::Duration::from_millis(50));
    drop(second);
    assert_eq!(seen_of(guid, "lost"), ["found", "lost"]);
    drop(first);
  }

  // The discovery thread has a handle for a moment, for example while it announces the participant, and may
  // not be the one that drops the last.
  #[test]
  fn a_participant_that_is_dropped_has_ended_its_threads() {
    for round in 0..1_000 {
      let held = std::sync::Arc::new(());
      let of_hook = held.clone();
      let participant = DomainParticipantBuilder::new(test_domain_id(44))
        .on_received(move || {
          let _ = &of_hook;
          false
        })
        .build()
        .unwrap();
      std::thread::sleep(std::time::Duration::from_micros(round % 100 * 10));
      drop(participant);
      assert_eq!(std::sync::Arc::strong_count(&held), 1, "round {round}: a thread runs on");
    }
  }

  // In one process the former participant says goodbye, which is of no matter here.
  #[test]
  fn a_participant_continues_the_identity_of_a_former_one() {
    let domain = test_domain_id(45);
    let former = DomainParticipant::new(domain).unwrap();
    let identity = announced(&former, 0);
    assert_eq!(&identity.prefix, former.guid().prefix.as_ref());
    let reserved = ParticipantIdentity {
      highest_count: identity.highest_count + 10_000,
      highest_number: identity.highest_number + 10_000,
      ..identity
    };
    let continued = || DomainParticipantBuilder::new(domain).continuing(reserved).build();
    assert!(continued().is_err(), "the ports are taken");
    let guid = former.guid();
    drop(former);

    let after = continued().unwrap();
    assert_eq!(after.guid(), guid);
    let identity = announced(&after, reserved.highest_number);
    assert_eq!(identity.participant_id, reserved.participant_id);
    drop(after);

    let beyond = ParticipantIdentity {
      highest_count: i32::MAX - 1,
      ..reserved
    };
    assert!(DomainParticipantBuilder::new(domain).continuing(beyond).build().is_err());
  }

  // What others sent while there was no process is received by the next one, whose sockets have
  // the same ports, the one of the urgent topics too; but not before it has readers.
  #[test]
  #[cfg(unix)]
  fn a_participant_takes_over_the_sockets_of_a_former_one() {
    let domain = test_domain_id(50);
    let urgent = || ["t".to_string()];
    let former = DomainParticipantBuilder::new(domain)
      .with_urgent_topics(urgent())
      .with_sockets(Vec::new())
      .build()
      .unwrap();
    let identity = announced(&former, 0);
    assert_ne!(identity.urgent_port, 0);
    let kept = former.sockets().unwrap();
    assert!(former.sockets().is_err(), "they were taken");
    let ports = |sockets: &[std::net::UdpSocket]| -> std::collections::BTreeSet<u16> {
      sockets.iter().map(|socket| socket.local_addr().unwrap().port()).collect()
    };
    let former_ports = ports(&kept);
    assert_eq!(former_ports.len(), 5);
    drop(former);

    let other = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    other.send_to(b"not RTPS", ("127.0.0.1", identity.urgent_port)).unwrap();
    let continued = |sockets| {
      DomainParticipantBuilder::new(domain)
        .with_urgent_topics(urgent())
        .continuing(identity)
        .with_sockets(sockets)
        .holding_user_traffic()
        .build()
    };
    assert!(continued(Vec::new()).is_err(), "the ports are taken by what was kept");
    let peeked = kept.iter().find(|socket| {
      socket.local_addr().unwrap().port() == identity.urgent_port
    });
    let peeked = peeked.unwrap().try_clone().unwrap();
    let after = continued(kept).unwrap();
    assert_eq!(ports(&after.sockets().unwrap()), former_ports);
    let waits = || peeked.peek(&mut [0; 16]).is_ok();
    std::thread::sleep(std::time::Duration::from_millis(100));
    assert!(waits(), "received without readers");
    after.receive_user_traffic();
    while waits() {
      std::thread::sleep(std::time::Duration::from_millis(1));
    }
    assert_eq!(announced(&after, 0).urgent_port, identity.urgent_port);
  }

  // A process that takes over the socket of one that was killed receives what the application of
  // that one did not have yet; a participant that is another one does not.
  #[test]
  #[cfg(unix)]
  fn a_datagram_stays_in_its_socket_until_the_application_was_called() {
    use std::{
      collections::BTreeSet,
      net::UdpSocket,
      sync::{Arc, Mutex, OnceLock},
    };
    let domain = test_domain_id(52);
    // The first byte of the next datagram in the socket. The test sends numbers; a participant sends ACKNACKs to
    // itself there when it answers its own HEARTBEATs of discovery, and these begin with an R.
    let number_in = |socket: &UdpSocket| {
      let mut number = [0];
      socket.peek(&mut number).ok().map(|_| number[0])
    };
    // The hook may be called before the sockets of a new participant are known.
    let open = |sockets, socket: &Arc<OnceLock<UdpSocket>>| {
      let seen = Arc::new(Mutex::new(BTreeSet::new()));
      let (in_hook, numbers) = (Arc::clone(socket), Arc::clone(&seen));
      let hook = move || {
        numbers.lock().unwrap().extend(in_hook.get().and_then(number_in));
        false
      };
      let participant = DomainParticipantBuilder::new(domain)
        .with_sockets(sockets)
        .on_received(hook)
        .build()
        .unwrap();
      let sockets = participant.sockets().unwrap();
      // RTPS v2.5 Section 9.6.2.4: the ports of user traffic are odd, the first one is that of multicast.
      let port_of = |socket: &UdpSocket| socket.local_addr().unwrap().port();
      let user_traffic = sockets.iter().filter(|socket| port_of(socket) % 2 == 1).max_by_key(|it| port_of(it));
      let user_traffic = user_traffic.unwrap().try_clone().unwrap();
      let port = port_of(&user_traffic);
      let _ = socket.set(user_traffic);
      (participant, sockets, seen, port)
    };
    let waiting = |socket: &OnceLock<UdpSocket>| number_in(socket.get().unwrap());
    let pause = || std::thread::sleep(std::time::Duration::from_millis(1));
    let socket = Arc::new(OnceLock::new());
    let (former, sockets, seen, port) = open(Vec::new(), &socket);
    let other = UdpSocket::bind("127.0.0.1:0").unwrap();
    for number in 1..=20 {
      other.send_to(&[number], ("127.0.0.1", port)).unwrap();
      while !seen.lock().unwrap().contains(&number) || waiting(&socket) == Some(number) {
        pause();
      }
    }
    drop(former);
    while socket.get().unwrap().recv(&mut [0]).is_ok() {}
    other.send_to(&[21], ("127.0.0.1", port)).unwrap();
    // On a busy machine the kernel delivers it later, in a thread of its own.
    while waiting(&socket) != Some(21) {
      pause();
    }
    let (_next, _sockets, seen, next_port) = open(sockets, &socket);
    assert_eq!(next_port, port);
    std::thread::sleep(std::time::Duration::from_millis(100));
    assert_ne!(waiting(&socket), Some(21));
    assert!(!seen.lock().unwrap().contains(&21));
  }

  // A writer with a given entity id tells each number that it gives, the first one too.
  #[test]
  fn a_writer_continues_one_of_a_former_process() {
    let domain = test_domain_id(46);
    let participant = DomainParticipant::new(domain).unwrap();
    let qos = QosPolicies::qos_none();
    let topic = participant
      .create_topic("t".to_string(), "t".to_string(), &qos, TopicKind::NoKey)
      .unwrap();
    let publisher = participant.create_publisher(&qos).unwrap();
    let told = std::sync::Arc::new(std::sync::atomic::AtomicI64::new(0));
    let continued = |highest_number| {
      let told = std::sync::Arc::clone(&told);
      crate::ContinuedWriter {
        entity_key: [0xff, 1, 2],
        highest_number,
        samples: Vec::new(),
        sent_through: highest_number,
        readers: Vec::new(),
        on_number: Box::new(move |n, _| told.store(n, std::sync::atomic::Ordering::Relaxed)),
      }
    };
    type Adapter = CDRSerializerAdapter<RandomData, LittleEndian>;
    let create = |highest| {
      publisher.create_datawriter_raw_continuing::<RandomData, Adapter>(
        &topic,
        None,
        continued(highest),
      )
    };
    assert!(create(-1).is_err());
    assert!(create(i64::MAX).is_err());
    let writer = create(99).unwrap();
    assert_eq!(writer.guid().entity_id.entity_key, [0xff, 1, 2]);
    assert_eq!(writer.guid().prefix, participant.guid().prefix);
    let data = RandomData { a: 1, b: "b".to_string() };
    writer.write(data, None).unwrap();
    assert_eq!(told.load(std::sync::atomic::Ordering::Relaxed), 100);
  }

  // TODO: improve basic test when more or the structure is known
  #[test]
  fn dp_basic_domain_participant() {
    // let _dp = DomainParticipant::new();

    let sender = UDPSender::new(user_traffic_multicast_port(test_domain_id(16))).unwrap();
    let data: Vec<u8> = vec![0, 1, 2, 3, 4];

    let addrs = vec![SocketAddr::new(
      "127.0.0.1".parse().unwrap(),
      spdp_well_known_unicast_port(test_domain_id(0), 1),
    )];
    sender.send_to_all(&data, &addrs);

    // TODO: get result data from Reader
  }
  #[test]
  fn dp_writer_heartbeat_test() {
    let domain_participant =
      DomainParticipant::new(test_domain_id(0)).expect("Participant creation failed!");
    let qos = QosPolicies::qos_none();
    let _default_dw_qos = QosPolicies::qos_none();
    let publisher = domain_participant
      .create_publisher(&qos)
      .expect("Failed to create publisher");

    let topic = domain_participant
      .create_topic(
        "Aasii".to_string(),
        "RandomData".to_string(),
        &qos,
        TopicKind::WithKey,
      )
      .expect("Failed to create topic");

    let mut _data_writer = publisher
      .create_datawriter::<RandomData, CDRSerializerAdapter<RandomData, LittleEndian>>(&topic, None)
      .expect("Failed to create datawriter");
  }

  #[test]
  fn a_topic_is_kept_until_it_is_forgotten() {
    let participant = DomainParticipant::new(test_domain_id(0)).unwrap();
    let topic = participant
      .create_topic(
        "Forgotten".to_string(),
        "RandomData".to_string(),
        &QosPolicies::qos_none(),
        TopicKind::NoKey,
      )
      .unwrap();
    participant.begin_now(&topic).unwrap();
    participant.forget_topic("Forgotten");
    participant.forget_topic("Forgotten");
    participant.begin_now(&topic).unwrap_err();
  }

  #[test]
  fn dp_receive_acknack_message_test() {
    // TODO SEND ACKNACK
    let domain_participant =
      DomainParticipant::new(test_domain_id(0)).expect("Failed to create participant");

    let qos = QosPolicies::qos_none();
    let _default_dw_qos = QosPolicies::qos_none();

    let publisher = domain_participant
      .create_publisher(&qos)
      .expect("Failed to create publisher");

    let topic = domain_participant
      .create_topic(
        "Aasii".to_string(),
        "Huh?".to_string(),
        &qos,
        TopicKind::WithKey,
      )
      .expect("Failed to create topic");

    let mut _data_writer = publisher
      .create_datawriter::<RandomData, CDRSerializerAdapter<RandomData, LittleEndian>>(&topic, None)
      .expect("Failed to create datawriter");

    let port_number: u16 = user_traffic_unicast_port(test_domain_id(5), 0);
    let sender = UDPSender::new(1234).unwrap();
    let mut m: Message = Message::default();

    let a: AckNack = AckNack {
      reader_id: EntityId::SPDP_BUILTIN_PARTICIPANT_READER,
      writer_id: EntityId::SPDP_BUILTIN_PARTICIPANT_WRITER,
      reader_sn_state: SequenceNumberSet::from_base_and_set(
        SequenceNumber::default(),
        &BTreeSet::new(),
      ),
      count: 1,
    };
    let flags = BitFlags::<ACKNACK_Flags>::from_endianness(Endianness::BigEndian);
    let sub_header: SubmessageHeader = SubmessageHeader {
      kind: SubmessageKind::ACKNACK,
      flags: flags.bits(),
      content_length: 24,
    };

    let s: Submessage = Submessage {
      header: sub_header,
      body: SubmessageBody::Reader(ReaderSubmessage::AckNack(a, flags)),
      original_bytes: None,
    };
    let h = Header {
      protocol_id: ProtocolId::default(),
      protocol_version: ProtocolVersion { major: 2, minor: 3 },
      vendor_id: VendorId::THIS_IMPLEMENTATION,
      guid_prefix: GUID::default().prefix,
    };
    m.set_header(h);
    m.add_submessage(s);
    let _data: Vec<u8> = m.write_to_vec_with_ctx(Endianness::LittleEndian).unwrap();
    info!("data to send via udp: {_data:?}");
    let ip = Ipv4Addr::from([0x00, 0x00, 0x00, 0x00]);
    let socket_address = SocketAddrV4::new(ip, port_number);
    let locators = vec![Locator::UdpV4(socket_address)];
    sender.send_to_locator_list(&_data, &locators);
  }
}
