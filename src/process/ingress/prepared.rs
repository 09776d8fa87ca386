//! The pools of a standby of ingress, which creates them before it has the role: beside images they took 10
//! of the 30 ms of a take-over. Lanes connect to them meanwhile; nothing is published there.

use tracing::warn;

use crate::config::Settings;
use crate::shm::{PoolBudget, RouteChannel, SamplePublisher, ShmError, ShmNode};

/// The pools of a process that waits for the role.
pub(super) enum PreparedPools {
    /// Not created yet, or not needed: the process does not wait.
    None,
    /// The pool of each route, with the channel for which it was created.
    Created(Vec<(RouteChannel, SamplePublisher)>),
    /// They could not be created. The process tries again when it has the role.
    Failed,
}

impl PreparedPools {
    /// Creates the pools at the first call, and connects them to new lanes later. For each turn of a process
    /// that waits.
    pub fn follow(&mut self, node: &ShmNode, settings: &Settings) {
        match self {
            Self::None => {
                *self = match create(node, settings) {
                    Ok(pools) => Self::Created(channels(settings).zip(pools).collect()),
                    Err(error) => {
                        warn!(%error, "standby: creates its pools of samples only when it takes the role over");
                        Self::Failed
                    }
                }
            }
            Self::Created(pools) => pools.iter().for_each(|(_, pool)| pool.connect_subscribers()),
            Self::Failed => {}
        }
    }

    /// The pools of all routes for these settings: those that are created already, if they are for the same
    /// channels.
    pub fn finish(self, node: &ShmNode, settings: &Settings) -> Result<Vec<SamplePublisher>, ShmError> {
        let channels: Vec<_> = channels(settings).collect();
        match self {
            Self::Created(pools) if pools.iter().map(|(channel, _)| channel).eq(&channels) => {
                Ok(pools.into_iter().map(|(_, pool)| pool).collect())
            }
            // iceoryx2 refuses another channel of a route while pools of the first one exist.
            other => {
                drop(other);
                create(node, settings)
            }
        }
    }
}

fn channels(settings: &Settings) -> impl Iterator<Item = RouteChannel> {
    (0..settings.routes.len()).map(|route| RouteChannel::of(settings, route))
}

fn create(node: &ShmNode, settings: &Settings) -> Result<Vec<SamplePublisher>, ShmError> {
    let budget = PoolBudget::of(settings);
    let create = |(route, channel): (usize, RouteChannel)| {
        SamplePublisher::create_within(node, &channel, &budget, route)
    };
    channels(settings).enumerate().map(create).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::process::test_role::{self, SCAN};
    use crate::shm::ProcessRole;

    #[test]
    fn a_standby_uses_the_pools_that_it_created_unless_the_channels_are_others() {
        let (_folder, role, settings) = test_role::open(ProcessRole::Ingress, "ingress", 171, SCAN);
        let file = |pool: &SamplePublisher| pool.lend(100).unwrap().place().0;
        let prepare = || {
            let mut pools = PreparedPools::None;
            (0..2).for_each(|_| pools.follow(&role.node, &settings));
            let PreparedPools::Created(created) = &pools else { panic!("not created") };
            let files: Vec<_> = created.iter().map(|(_, pool)| file(pool)).collect();
            (pools, files)
        };
        let (pools, created) = prepare();
        assert_eq!(created.len(), 1);
        let used = pools.finish(&role.node, &settings).unwrap();
        assert_eq!(used.iter().map(file).collect::<Vec<_>>(), created);
        drop(used);

        let mut others = settings.clone();
        others.routes[0].max_sample_bytes *= 2;
        let (pools, created) = prepare();
        let used = pools.finish(&role.node, &others).unwrap();
        assert_ne!(used.iter().map(file).collect::<Vec<_>>(), created);
        assert_eq!(used[0].max_sample_bytes(), others.routes[0].max_sample_bytes);
    }
}
