//! The layout with which a viewer opens the recording.

use super::content::RUN_TIME;
use super::scene::Reach;
use super::views::root;
use crate::telemetry::Scene;
use rerun::blueprint::components::{PanelState, PlayState};
use rerun::blueprint::{
    Blueprint, BlueprintActivation, BlueprintPanel, ContainerLike, SelectionPanel, TimePanel,
};
use rerun::external::re_log_types::BlueprintActivationCommand;
use rerun::log::LogMsg;
use rerun::{
    AsComponents, EntityPath, RecordingStream, RecordingStreamBuilder, RecordingStreamResult,
};

/// Embeds the layout in the recording and makes it the active one: a layout that the viewer kept
/// from another recording would win otherwise.
pub(super) fn send(
    stream: &RecordingStream,
    application: &'static str,
    scene: &Scene,
    reach: &Reach,
) -> RecordingStreamResult<()> {
    let mut properties = Properties::default();
    let blueprint = Blueprint::new(root(scene, reach, &mut properties))
        .with_auto_views(false)
        .with_auto_layout(false)
        .with_blueprint_panel(BlueprintPanel::from_state(PanelState::Collapsed))
        .with_selection_panel(SelectionPanel::from_state(PanelState::Collapsed))
        .with_time_panel(
            TimePanel::new()
                .with_state(PanelState::Collapsed)
                .with_timeline(RUN_TIME)
                .with_play_state(PlayState::Following),
        );
    let activation = BlueprintActivation { make_active: true, make_default: true };
    let carrier = RecordingStreamBuilder::new(application);
    let mut layout = messages(carrier, |carrier| blueprint.send(carrier, activation))?;
    layout.retain(|message| {
        message.store_id().is_blueprint()
            && !matches!(message, LogMsg::BlueprintActivationCommand(_))
    });
    let Some(blueprint_id) = layout.first().map(|message| message.store_id().clone()) else {
        return Ok(());
    };
    let extra = RecordingStreamBuilder::from_store_id(&blueprint_id).send_properties(false);
    let extra = messages(extra, |extra| {
        extra.set_time_sequence("blueprint", 0);
        properties.0.into_iter().try_for_each(|(path, property)| extra.log(path, property.as_ref()))
    })?;
    layout.extend(extra.into_iter().filter(|m| matches!(m, LogMsg::ArrowMsg(..))));
    let command = BlueprintActivationCommand {
        blueprint_id,
        make_active: activation.make_active,
        make_default: activation.make_default,
    };
    stream.send_blueprint(layout, command);
    Ok(())
}

/// The messages that `log` makes, of the recording or the layout of `builder`.
fn messages(
    builder: RecordingStreamBuilder,
    log: impl FnOnce(&RecordingStream) -> RecordingStreamResult<()>,
) -> RecordingStreamResult<Vec<LogMsg>> {
    let (stream, storage) = builder.enabled(true).memory()?;
    let logged = log(&stream);
    let messages = storage.take();
    // Its own storage holds it, so that it would never end.
    stream.disconnect();
    logged.map(|()| messages)
}

/// What linked views have in common, under the identity that the viewer has for it.
const SHARED: &str = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc";

/// Properties of views that rerun's typed views do not have: they are logged beside them.
#[derive(Default)]
pub(super) struct Properties(Vec<(EntityPath, Box<dyn AsComponents>)>);

impl Properties {
    /// Sets `properties` of `view`, each at its path under it.
    pub(super) fn set(
        &mut self,
        view: impl Into<ContainerLike>,
        properties: impl IntoIterator<Item = (String, Box<dyn AsComponents>)>,
    ) -> ContainerLike {
        let view = view.into();
        if let ContainerLike::View(view) = &view {
            self.set_at(&view.blueprint_path(), properties);
        }
        view
    }

    /// Sets `properties` that linked views have in common.
    pub(super) fn set_shared(
        &mut self,
        properties: impl IntoIterator<Item = (String, Box<dyn AsComponents>)>,
    ) {
        self.set_at(&EntityPath::from(SHARED), properties);
    }

    fn set_at(
        &mut self,
        path: &EntityPath,
        properties: impl IntoIterator<Item = (String, Box<dyn AsComponents>)>,
    ) {
        let at = |(name, property): (String, _)| (path.join(&EntityPath::from(name)), property);
        self.0.extend(properties.into_iter().map(at));
    }
}
