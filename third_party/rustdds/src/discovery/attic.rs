//! Participants that are gone and may come back, with their readers and writers.
//!
//! What each has announced is one block of memory: its announcements as they go over the network.
//! As values, those of a ROS 2 node are about a hundred allocations, which share their pages with
//! others, so that the memory of a process grows although nothing is kept for long. After a goodbye
//! the participant's announcement is kept and not used, so that a process needs the same memory
//! however participants leave.

use std::collections::VecDeque;

use super::{
  journal::{append, next_record, ENCODING, PARTICIPANT, READER},
  sedp_messages::{DiscoveredReaderData, DiscoveredWriterData},
  spdp_participant_data::SpdpDiscoveredParticipantData,
};
use crate::{serialization::pl_cdr_adapters::PlCdrDeserialize, structure::guid::GuidPrefix};

/// The one that has been gone for longest is forgotten if there are more.
pub(crate) const MAX_PARTICIPANTS_IN_ATTIC: usize = 256;

/// Likewise. The endpoints of a ROS 2 node take about 5 KiB; those of a participant with as many
/// as discovery accepts, 4,096 of each kind, and 2 KiB each, all of it.
pub(crate) const MAX_ATTIC_BYTES: usize = 16 << 20;

const WRITER: u8 = 3;

#[derive(Default)]
pub(crate) struct Attic {
  // The one that has been gone for longest first.
  departed: VecDeque<Departed>,
  bytes: usize,
}

struct Departed {
  prefix: GuidPrefix,
  /// The participant's announcement, if it is known, and those of its endpoints.
  announced: Box<[u8]>,
  /// Whether it has said no goodbye, and its announcement has not been taken.
  may_return: bool,
}

/// The readers and writers of a participant.
pub(crate) type Endpoints = (Vec<DiscoveredReaderData>, Vec<DiscoveredWriterData>);

impl Attic {
  #[cfg(test)]
  pub fn contains(&self, prefix: GuidPrefix) -> bool {
    self.departed.iter().any(|departed| departed.prefix == prefix)
  }

  /// Remembers a participant that is not in the attic; whether it `may_return`, so that its
  /// announcement is for [`Self::take_announcement`].
  pub fn remember(
    &mut self,
    prefix: GuidPrefix,
    (readers, writers): &Endpoints,
    announcement: Option<&SpdpDiscoveredParticipantData>,
    may_return: bool,
  ) {
    let mut announced = Vec::new();
    if let Some(announcement) = announcement {
      append(&mut announced, PARTICIPANT, announcement);
    }
    for reader in readers {
      append(&mut announced, READER, reader);
    }
    for writer in writers {
      append(&mut announced, WRITER, writer);
    }
    self.bytes += announced.len();
    self.departed.push_back(Departed {
      prefix,
      announced: announced.as_slice().into(),
      may_return,
    });
    while self.departed.len() > MAX_PARTICIPANTS_IN_ATTIC || self.bytes > MAX_ATTIC_BYTES {
      let Some(forgotten) = self.departed.pop_front() else { return };
      self.bytes -= forgotten.announced.len();
    }
  }

  /// The endpoints of a participant that is back.
  pub fn take(&mut self, prefix: GuidPrefix) -> Option<Endpoints> {
    let place = self.departed.iter().position(|departed| departed.prefix == prefix)?;
    let departed = self.departed.remove(place)?;
    self.bytes -= departed.announced.len();
    let mut records = &departed.announced[..];
    let (mut readers, mut writers) = Endpoints::default();
    while let Some((kind, bytes)) = next_record(&mut records) {
      match kind {
        READER => readers.extend(DiscoveredReaderData::from_pl_cdr_bytes(bytes, ENCODING)),
        WRITER => writers.extend(DiscoveredWriterData::from_pl_cdr_bytes(bytes, ENCODING)),
        _ => {}
      }
    }
    Some((readers, writers))
  }

  /// What a participant that did not say goodbye announced last. It remains in the attic without
  /// that.
  pub fn take_announcement(&mut self, prefix: GuidPrefix) -> Option<SpdpDiscoveredParticipantData> {
    let mut departed = self.departed.iter_mut();
    let departed = departed.find(|departed| departed.prefix == prefix)?;
    if !std::mem::take(&mut departed.may_return) {
      return None;
    }
    let (kind, bytes) = next_record(&mut &departed.announced[..])?;
    let announcement = SpdpDiscoveredParticipantData::from_pl_cdr_bytes(bytes, ENCODING);
    announcement.ok().filter(|_| kind == PARTICIPANT)
  }

  #[cfg(test)]
  pub fn participants(&self) -> usize {
    self.departed.len()
  }

  #[cfg(test)]
  pub fn bytes(&self) -> usize {
    self.bytes
  }
}

#[cfg(test)]
mod tests {
  use std::time::Instant;

  use super::*;
  use crate::{
    dds::qos::{policy, QosPolicies},
    discovery::{
      discovery_db::tests::{new_participant, new_reader},
      PublicationBuiltinTopicData, SubscriptionBuiltinTopicData, WriterProxy,
    },
    structure::{duration::Duration, guid::GUID, locator::Locator},
  };

  // With each policy that an announcement has.
  fn qos() -> QosPolicies {
    QosPolicies {
      durability: Some(policy::Durability::TransientLocal),
      presentation: Some(policy::Presentation {
        access_scope: policy::PresentationAccessScope::Topic,
        coherent_access: true,
        ordered_access: false,
      }),
      deadline: Some(policy::Deadline(Duration::from_millis(100))),
      latency_budget: Some(policy::LatencyBudget { duration: Duration::from_millis(10) }),
      ownership: Some(policy::Ownership::Exclusive { strength: 7 }),
      liveliness: Some(policy::Liveliness::ManualByTopic { lease_duration: Duration::from_secs(3) }),
      time_based_filter: Some(policy::TimeBasedFilter {
        minimum_separation: Duration::from_millis(20),
      }),
      reliability: Some(policy::Reliability::Reliable {
        max_blocking_time: Duration::from_millis(250),
      }),
      destination_order: Some(policy::DestinationOrder::BySourceTimeStamp),
      lifespan: Some(policy::Lifespan { duration: Duration::from_secs(9) }),
      data_representation: Some(policy::DataRepresentation {
        value: vec![policy::XCDR2_DATA_REPRESENTATION],
      }),
      ..QosPolicies::qos_none()
    }
  }

  fn endpoints(participant: GUID) -> Endpoints {
    let locators = vec![
      Locator::UdpV4("192.0.2.1:7411".parse().unwrap()),
      Locator::UdpV6("[2001:db8::1]:7411".parse().unwrap()),
      Locator::Other { kind: 16, port: 7411, address: [5; 16] },
    ];
    let mut reader = new_reader(participant, 1, "rt/scan");
    let guid = reader.reader_proxy.remote_reader_guid;
    reader.reader_proxy.unicast_locator_list = locators.clone();
    reader.reader_proxy.multicast_locator_list = locators[..1].to_vec();
    reader.reader_proxy.expects_inline_qos = true;
    reader.user_data = b"typehash=RIHS01_00;".to_vec();
    reader.subscription_topic_data = SubscriptionBuiltinTopicData::new(
      guid,
      Some(participant),
      "rt/scan".to_string(),
      "sensor_msgs::msg::dds_::LaserScan_".to_string(),
      &qos(),
      None,
    );
    let mut publication_topic_data = PublicationBuiltinTopicData::new(
      guid,
      Some(participant),
      "rt/odom".to_string(),
      "nav_msgs::msg::dds_::Odometry_".to_string(),
      None,
    );
    publication_topic_data.set_qos(&qos());
    let writer = DiscoveredWriterData {
      last_updated: Instant::now(),
      writer_proxy: WriterProxy::new(guid, locators, Vec::new()),
      publication_topic_data,
      user_data: vec![1, 2, 3],
    };
    (vec![reader], vec![writer])
  }

  #[test]
  fn what_is_remembered_comes_back_unchanged() {
    let mut attic = Attic::default();
    let participant = new_participant();
    let prefix = participant.participant_guid.prefix;
    let known = endpoints(participant.participant_guid);
    attic.remember(prefix, &known, Some(&participant), true);
    assert!(attic.contains(prefix));
    let mut announcement = attic.take_announcement(prefix).unwrap();
    announcement.updated_time = participant.updated_time; // it is not announced
    assert_eq!(announcement, participant);
    assert!(attic.take_announcement(prefix).is_none() && attic.contains(prefix));
    let (readers, mut writers) = attic.take(prefix).unwrap();
    assert_eq!(readers, known.0);
    writers[0].last_updated = known.1[0].last_updated; // it is not announced
    assert_eq!(writers, known.1);
    assert!(attic.take(prefix).is_none() && !attic.contains(prefix));
    assert_eq!(attic.bytes(), 0);
  }

  #[test]
  fn a_participant_that_said_goodbye_or_was_never_announced_is_not_announced() {
    let participant = new_participant();
    let prefix = participant.participant_guid.prefix;
    let known = endpoints(participant.participant_guid);
    for (announcement, may_return) in [(Some(&participant), false), (None, true)] {
      let mut attic = Attic::default();
      attic.remember(prefix, &known, announcement, may_return);
      assert!(attic.take_announcement(prefix).is_none());
      assert_eq!(attic.take(prefix).unwrap().0, known.0);
    }
  }
}
