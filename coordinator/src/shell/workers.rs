//! Workers: they join, ask, deliver and leave.

use std::{sync::Arc, time::Duration};

use rtfarm_core::tile::TileId;
use rtfarm_proto::{Bytes, JobId, LeaseName, Renewal, WorkerId};
use tokio::sync::oneshot;

use super::{Batch, Shell};
use crate::{
    farm::{Delivery, DeliveryId, Next, Verdict},
    job::Job,
    lease::Run,
    members::{KeptOut, MemberEntry, NoMember, Process, Standing},
    waiting::{Ask, AskId},
};

impl Shell {
    pub(crate) fn join(&self, process: Process) -> Result<WorkerId, KeptOut> {
        self.tell(|state, now| state.farm.on_join(process, now))
    }

    /// Asks for tiles, and waits for them that long.
    pub(crate) async fn ask(
        &self,
        worker: WorkerId,
        most: usize,
        wait: Duration,
    ) -> Result<Next, NoMember> {
        let (reply, answer) = oneshot::channel();
        let id = self.tell(|state, now| {
            let id = AskId(state.next_number());
            state.asks.insert(id, reply);
            (id, state.farm.on_ask(id, Ask { worker, most, until: now + wait }, now))
        });
        let _line = Line { shell: self, id };
        answer.await.expect("every question is answered")
    }

    /// Offers tiles of a job whose pixels a worker has. It gets those that it may bring.
    pub(crate) fn offer(&self, worker: WorkerId, job: JobId, tiles: &[u32]) -> Option<Run> {
        self.tell(|state, now| (state.farm.on_offer(worker, job, tiles, now), Vec::new()))
    }

    pub(crate) fn renew(
        &self,
        worker: WorkerId,
        renewals: &[Renewal],
    ) -> Result<Vec<LeaseName>, NoMember> {
        self.tell(|state, now| (state.farm.on_renew(worker, renewals, now), Vec::new()))
    }

    /// A tile of a job that is being rendered, and that job.
    pub(crate) fn tile(&self, job: JobId, number: u32) -> Option<(TileId, Arc<Job>)> {
        let state = self.state();
        let tile = state.farm.tile(job, number)?;
        Some((tile, Arc::clone(state.jobs.get(&job)?)))
    }

    /// Brings the pixels of tiles. The verdicts come when all are safe. This writes a file: never
    /// call it on the async runtime.
    pub(crate) fn deliver(&self, tiles: Vec<(Delivery, Bytes)>) -> oneshot::Receiver<Vec<Verdict>> {
        let (reply, verdicts) = oneshot::channel();
        let (deliveries, pixels): (Vec<Delivery>, Vec<Bytes>) = tiles.into_iter().unzip();
        let count = deliveries.len();
        self.tell(|state, now| {
            let first = state.last_number + 1;
            state.last_number += count as u64;
            let verdicts = vec![Verdict::Rejected; count];
            let numbered = (first..).map(DeliveryId).zip(deliveries.clone());
            let batch = Batch { deliveries, pixels, verdicts, undecided_count: count, reply };
            state.batches.insert(DeliveryId(first), batch);
            let arrived = |(id, delivery)| state.farm.on_pixels(id, delivery, now);
            ((), numbered.flat_map(arrived).collect())
        });
        verdicts
    }

    pub(crate) fn report_senseless_pixels(
        &self,
        worker: WorkerId,
        lease: LeaseName,
        tile: TileId,
        reason: &str,
    ) {
        self.tell_farm(|farm, now| farm.on_senseless_pixels(worker, lease, tile, reason, now));
    }

    pub(crate) fn leave(&self, worker: WorkerId, reason: &str) {
        self.tell_farm(|farm, now| farm.on_leave(worker, reason, now));
    }

    pub(crate) fn report_process_exit(&self, process: u32, reason: &str) {
        self.tell_farm(|farm, now| farm.on_process_exit(process, reason, now));
    }

    /// The workers, and how many tiles each has.
    pub(crate) fn workers(&self) -> Vec<(MemberEntry, usize)> {
        self.tell(|state, now| (state.farm.worker_entries(now), Vec::new()))
    }

    /// The tiles of a job that workers have, and whether they are known to have begun them.
    pub(crate) fn in_work(&self, job: JobId) -> Vec<(TileId, WorkerId, bool)> {
        self.state().farm.in_work(job)
    }

    /// Says whether nobody is there to render.
    pub(crate) fn lacks_workers(&self) -> bool {
        self.state().farm.lacks_workers()
    }

    /// Decides what a worker gets.
    pub(crate) fn station(&self, worker: WorkerId, standing: Standing) -> Result<(), NoMember> {
        self.tell(|state, now| state.farm.on_station(worker, standing, now))
    }
}

/// A question on which somebody hangs on. It hangs up when it is dropped.
struct Line<'a> {
    shell: &'a Shell,
    id: AskId,
}

impl Drop for Line<'_> {
    fn drop(&mut self) {
        let mut state = self.shell.state();
        if state.asks.remove(&self.id).is_some() {
            state.farm.on_hang_up(self.id);
        }
    }
}
